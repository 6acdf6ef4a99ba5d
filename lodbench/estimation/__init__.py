"""What methods that align a map share: from a state vector and its prior to a posterior and its probability.

``state_vector``         columns of what is estimated, differences, the views that vectors stand for
``prior``                what is known before the photo
``outline``              points on a silhouette's outline, and their Jacobian
``outline_alignment``    Gauss-Newton on the distances of two outlines
``outline_errors``       the noise of an outline, and the covariance of its points
``normal_equations``     quadratics and their steps; sparse normal equations, scales of groups of errors
``lens``                 a camera that is not as declared
``model_lines``          points on the model's visible lines, and their Jacobian
``photo_edges``          edges of a photo across such lines
``edge_alignment``       Gauss-Newton on their distances
``evolution``            local search without derivatives
``posterior``            shares of modes, the posterior's mean, its covariance under errors of the map
``probability``          Gaussians, and the probability that an answer is right
"""
