"""What the edges of one photo leave open: poses refined from the true ones, the best start there is."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.estimation.edge_alignment import EdgeLikelihood
from lodbench.geometry import Pose
from lodbench.geometry.pose_vector import pose_from_vector, vector_from_pose
from lodbench.methods.fits import query_photo
from lodbench.methods.protocol import Estimate, Streams


class EdgeBound:
    """The least squares that ``region`` ends with, given map, camera and where to begin: the true pose.

    Args:
        truths: By the query's name, scene frame.
        prior: Half widths of the priors' errors.
    """

    name = "edges from truth"
    requires = frozenset({Input.IMAGE})

    def __init__(self, truths: Mapping[str, Pose], prior: UniformPrior) -> None:
        half = np.array([prior.x_m, prior.y_m, prior.z_m, prior.pitch_deg, prior.roll_deg, prior.yaw_deg])
        self._truths = truths
        self._sigmas = np.append(np.maximum(half, 1e-3) / np.sqrt(3.0), np.zeros(4))

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the pose that edges and prior make most probable near the true one.

        Raises:
            QueryFault: There is no photo, or too few roof lines are in view.
        """
        prior = vector_from_pose(query.prior)
        edges = EdgeLikelihood(query_photo(query), query.camera, city_map, prior, self._sigmas)
        found = edges.refined(vector_from_pose(self._truths[query.name]))
        if found is None:
            raise QueryFault("too few roof lines are in view")
        return Estimate(pose_from_vector(found.vector), 1.0, covariance=found.covariance)
