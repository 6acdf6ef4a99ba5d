"""The mean of the poses that a photo leaves, instead of the one that fits it best.

The fit has steps of its own below a pixel, and ridges along which tilt and place make up for each other: its
top is one of many bumps, metres apart on a ridge. Their mean, weighed by the posterior, is nearer to the
truth (docs/adr/0044).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lodbench.storage import random_stream

Floats = NDArray[np.float64]

# Poses of a round, even, and how many rounds there are; the mean is that of all but the first.
_POSES, _ROUNDS = 1024, 3
# Draws lie a little wider than what they stand for, and part of each round's width stays from the one before:
# tails that no draw reaches are lost.
_WIDTH, _KEPT = 1.1, 0.3


def posterior_mean(
    log_posterior: Callable[[Floats], Floats],
    vector: Floats,
    covariance: Floats,
) -> Floats:
    """Returns the mean of the posterior around a point, (D,): a pose, and what else is not known.

    By adaptive importance sampling: poses are drawn from a Gaussian and weigh what the posterior is over its
    density; the next Gaussian is theirs (Bugallo et al., "Adaptive importance sampling", 2017).

    Args:
        log_posterior: (N, D) points to the (N,) logarithm of their posterior, up to a constant.
        vector: (D,) the best point.
        covariance: (D, D) how far the mean may be from it.
    """
    # The same draws for every query: the answer is a function of photo, prior and map.
    generator = random_stream(0, "posterior mean of the region fit")
    means, spread = [vector], covariance
    for _ in range(_ROUNDS):
        squares, axes = np.linalg.eigh(spread)
        half = generator.standard_normal((_POSES // 2, len(vector)))
        moves = np.concatenate([half, -half])
        # The symmetric root: it does not depend on the signs that a library of linear algebra gives axes.
        root = (axes * np.sqrt(np.maximum(squares, 0.0))) @ axes.T
        poses = means[-1] + _WIDTH * moves @ root
        logs = log_posterior(poses) + 0.5 * (moves**2).sum(axis=1)
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        means.append(weights @ poses)
        away = poses - means[-1]
        spread = _KEPT * spread + (1.0 - _KEPT) * (away.T * weights) @ away
    return np.asarray(np.mean(means[2:], axis=0))
