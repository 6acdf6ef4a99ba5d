"""The mean of the poses that a photo leaves, instead of the one that fits it best.

The fit has steps of its own below a pixel, and ridges along which tilt and place make up for each other: its
top is one of many bumps, metres apart on a ridge. Their mean, weighed by the posterior, is nearer to the
truth (docs/adr/0044).

How much a photo's nats count is told by the photo (docs/adr/0056). Hundreds of lines seem to say a place to a
decimetre, but err together; a few say no more than they know.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.methods.region.roots import brent_root
from lodbench.storage import random_stream

Floats = NDArray[np.float64]

# Poses of a round, even, and how many rounds there are.
_POSES, _ROUNDS = 128, 12
# Draws lie a little wider than what they stand for, and part of each round's width stays from the one before:
# tails that no draw reaches are lost.
_WIDTH, _KEPT = 1.1, 0.3
# The share of the nats that counts in the first draw, and the least.
_FIRST_SHARE, _LEAST_SHARE = 0.25, 0.05
_PLACE = slice(0, 3)
# The least variance: what is known exactly, as the tilt of priors of the true one.
_LEAST_SQUARE = 1e-18


class _Gaussian(NamedTuple):
    """What poses are drawn from.

    Attributes:
        mean: (D,).
        axes: (D, D) its own, a column each.
        deviations: (D,) along them.
    """

    mean: Floats
    axes: Floats
    deviations: Floats

    @classmethod
    def of(cls, mean: Floats, covariance: Floats) -> _Gaussian:
        squares, axes = np.linalg.eigh(covariance)
        return cls(mean, axes, np.sqrt(np.maximum(squares, _LEAST_SQUARE)))

    def drawn(self, generator: np.random.Generator) -> Floats:
        """Returns the poses of a round, each with its mirror image, (N, D)."""
        half = generator.standard_normal((_POSES // 2, len(self.mean)))
        # The symmetric root: it does not depend on the signs that a library of linear algebra gives axes.
        return self.mean + np.concatenate([half, -half]) @ ((self.axes * self.deviations) @ self.axes.T)

    def log_density(self, poses: Floats) -> Floats:
        """Returns the (N,) logarithm of the density at poses, up to a constant that all Gaussians share."""
        away = (poses - self.mean) @ self.axes / self.deviations
        return np.asarray(-0.5 * (away**2).sum(axis=1) - np.log(self.deviations).sum())


def posterior_mean(
    nats: Callable[[Floats, float], Floats],
    log_prior: Callable[[Floats], Floats],
    vector: Floats,
    covariance: Floats,
    least_m: float,
) -> Floats:
    """Returns the mean of the posterior around a point, (D,): a pose, and what else is not known.

    Eq. (R16) of docs/methods/region.md.

    By adaptive multiple importance sampling: poses are drawn from a Gaussian, the next Gaussian is that of
    all poses so far, and each weighs what the posterior is there over the mean density of all Gaussians
    (Cornuet et al., "Adaptive multiple importance sampling", 2012; docs/adr/0066).
    The likelihood is tempered as far as the place needs to be ``least_m`` wide.

    Args:
        nats: (N, D) points and a share to the (N,) logarithm of the likelihood of such a share of the
            photo's evidence, up to a constant of that share.
        log_prior: (N, D) points to the (N,) logarithm of their prior, up to a constant.
        vector: (D,) the best point.
        covariance: (D, D) how far the mean may be from it.
        least_m: Least deviation of the place, over its three numbers together, metres.
    """
    # The same draws for every query: the answer is a function of photo, prior and map.
    generator = random_stream(0, "posterior mean of the region fit")
    mean, spread, share = vector, covariance, _FIRST_SHARE
    gaussians: list[_Gaussian] = []
    poses, whole, priors = np.zeros((0, len(vector))), np.zeros(0), np.zeros(0)
    for _ in range(_ROUNDS):
        gaussians.append(_Gaussian.of(mean, _WIDTH**2 * spread))
        drawn = gaussians[-1].drawn(generator)
        poses = np.concatenate([poses, drawn])
        # Against the best point at the same share: what a share alone adds is no pose's (docs/adr/0066).
        *told, level = nats(np.concatenate([drawn, vector[None]]), share) / share
        whole = np.append(whole, np.array(told) - level)
        priors = np.append(priors, log_prior(drawn))
        rest = priors - scipy.special.logsumexp(
            [gaussian.log_density(poses) for gaussian in gaussians], axis=0
        )
        share = _share_that_leaves(least_m, poses, whole, rest)
        mean, own = _moments(poses, share * whole + rest)
        spread = _KEPT * spread + (1.0 - _KEPT) * own
    return mean


def _share_that_leaves(least_m: float, poses: Floats, nats: Floats, rest: Floats) -> float:
    """Returns which share of the nats leaves the place so wide, metres; all where they do.

    Eq. (R17) of docs/methods/region.md.
    """

    def excess(log_share: float) -> float:
        _, covariance = _moments(poses, math.exp(log_share) * nats + rest)
        return math.sqrt(float(np.trace(covariance[_PLACE, _PLACE]))) - least_m

    least = math.log(_LEAST_SHARE)
    if excess(0.0) >= 0.0:
        return 1.0
    return math.exp(brent_root(excess, least, 0.0, 0.01)) if excess(least) > 0.0 else _LEAST_SHARE


def _moments(poses: Floats, logs: Floats) -> tuple[Floats, Floats]:
    """Returns mean (D,) and covariance (D, D) of poses of some weights, given by logarithms."""
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    mean = weights @ poses
    away = poses - mean
    return mean, (away.T * weights) @ away
