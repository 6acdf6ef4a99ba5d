"""The posterior of the pose: its mean, its covariance, and what errors of the map add.

The mean of the poses that a photo leaves, instead of the one that fits it best. The fit has steps of its
own below a pixel, and ridges along which tilt and place make up for each other: its maximum is one of many
local ones, metres apart on a ridge. Their mean, weighed by the posterior, is nearer to the truth
(docs/adr/0011, point 9).

How much a photo's nats count follows from the photo (docs/adr/0013, point 2). Hundreds of lines seem to fix a
place to a decimetre, but err together; a few say no more than they know.

How far a map's own errors may have led an answer astray: its covariance. The curvature of a likelihood says
how well a photo separates poses if the map is right. Houses stand half a metre beside where the map has
them, and roofs are higher or lower, each building's outline as a whole: few buildings leave much open that
thousands of pixels seem to say (docs/adr/0013, point 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.estimation.outline import OutlinePoints
from lodbench.estimation.state_vector import Gaussian
from lodbench.kernels import error_covariance
from lodbench.storage import random_stream

Floats = NDArray[np.float64]

# Poses that the curvature is read from: a quadratic of six numbers has 28 coefficients.
_SAMPLES = 192
_PAIRS = np.triu_indices(6)


def curvature_around(log_likelihood: Callable[[Floats], Floats], spread: Gaussian) -> Floats:
    """Returns the curvature (6, 6) of the likelihood at a mode: what the photo says if the map is right.

    Eq. (R18) of docs/methods/region.md. A quadratic is fitted to the (N,) log-likelihood of (N, 6) poses
    spread about the mode. What curves upwards there says nothing.
    """
    roots = spread.root()
    # The same draws for every query: the answer is a function of the mode alone.
    draws = random_stream(0, "curvature of the region fit").standard_normal((_SAMPLES // 2, 6))
    draws = np.concatenate([draws, -draws])
    values = log_likelihood(spread.mean + draws @ roots.T)
    design = np.column_stack([np.ones(len(draws)), draws, draws[:, _PAIRS[0]] * draws[:, _PAIRS[1]]])
    coefficients = np.linalg.lstsq(design, values, rcond=None)[0]
    hessian = np.zeros((6, 6))
    hessian[_PAIRS] = coefficients[7:]
    curvature, directions = np.linalg.eigh(-(hessian + hessian.T))
    back = np.linalg.inv(roots)
    information = back.T @ (directions * np.maximum(curvature, 0.0)) @ directions.T @ back
    return np.asarray(0.5 * (information + information.T))


def shares_of(evidence: Floats) -> Floats:
    """Returns (M,) the posterior shares of some modes or hypotheses, given (M,) log evidence of each.

    Eq. (R13) of docs/methods/region.md, where the widths of modes are taken to be alike.
    """
    weights = np.exp(evidence - evidence.max())
    return np.asarray(weights / weights.sum())


# Standard deviations, metres: where a building stands, how high its roof is as a whole and by parts, how high
# all roofs are, where walls end.
_PLACE_M, _ROOF_M, _PART_M, _ROOFS_M, _BASE_M = 0.5, 0.7, 0.7, 0.35, 0.1
# Pixels of the fine size: how far outlines of a photo err together with what is near them, and each point by
# itself; over which distance they do, and parts of a roof.
_TOGETHER_PX, _OWN_PX, _NEAR_PX, _PART_PX = 1.0, 1.0, 12.0, 20.0
# Columns of an outline's slopes: the pose, the lens, then its building's roof and base.
_POSE, _EAST_NORTH, _LENS, _ROOF, _BASE = slice(0, 6), slice(0, 2), 6, 7, 8
# More points say no more; fewer say nothing.
_MOST_POINTS, _LEAST_POINTS = 600, 6
# So that directions that no outline fixes can be divided by, as a share of the others.
_UNSEEN = 1e-6


def covariance_under_map_errors(
    information: Floats, prior_information: Floats, points: OutlinePoints, lens_percent: float
) -> Floats:
    """Returns the covariance (6, 6) of an answer's error, metres and degrees.

    Eq. (R19) of docs/methods/region.md.

    An answer is where the slopes of likelihood and prior cancel; each error of the map adds to the former in
    the way in which it moves the outline. So the curvature is that of outlines whose every pixel is worth the
    same, and the error is the sandwich of that curvature and the variance of its slope (White, "Maximum
    likelihood estimation of misspecified models", 1982).

    Args:
        information: (6, 6) curvature of the likelihood: how much a photo says if the map is right.
        prior_information: (6, 6) the same of the prior.
        points: The outline from the answer, at the fine size.
        lens_percent: Standard deviation of the focal length, percent.
    """
    if len(points) < _LEAST_POINTS:
        return np.asarray(np.linalg.inv(prior_information))
    # Every so many-th point stands for those that are left out.
    stride = math.ceil(len(points) / _MOST_POINTS)
    lengths = points.lengths[::stride] * stride
    slopes = points.slopes()[::stride]
    pulls = slopes[:, _POSE] * lengths[:, None]
    outline = pulls.T @ slopes[:, _POSE]
    outline += _UNSEEN * np.trace(outline) / len(outline) * np.eye(len(outline))
    worth = max(float(np.median(scipy.linalg.eigh(information, outline, eigvals_only=True))), 0.0)
    variance = _variance_of_pulls(pulls, slopes, points.pixels[::stride], points.buildings[::stride])
    for column, sigma in ((_ROOF, _ROOFS_M), (_LENS, lens_percent)):
        of_all = pulls.T @ slopes[:, column]
        variance += sigma**2 * np.outer(of_all, of_all)
    curvature = worth * outline + prior_information
    back = np.linalg.inv(curvature)
    covariance = back @ (curvature + worth**2 * variance) @ back
    return np.asarray(0.5 * (covariance + covariance.T))


def _variance_of_pulls(pulls: Floats, slopes: Floats, pixels: Floats, buildings: NDArray[np.int64]) -> Floats:
    """Returns (6, 6) how the sum of N points' pulls on the pose, (N, 6) per pixel, varies with buildings."""
    lower = error_covariance(
        np.ascontiguousarray(pixels),
        np.ascontiguousarray(slopes[:, _ROOF]),
        np.ascontiguousarray(slopes[:, _BASE]),
        np.ascontiguousarray(buildings),
        (_TOGETHER_PX**2, _OWN_PX**2),
        (_NEAR_PX, _PART_PX),
        (_ROOF_M**2, _PART_M**2, _BASE_M**2),
    )
    # Not by a library whose sums depend on how many threads it has.
    half = np.einsum("ia,ib->ab", pulls, np.einsum("ij,jb->ib", lower, pulls))
    own = np.einsum("ia,i,ib->ab", pulls, np.diagonal(lower), pulls)
    variance = half + half.T - own
    # A building that stands elsewhere moves as the camera does, the other way.
    of_buildings = np.zeros((int(buildings.max()) + 1, 6, 2))
    np.add.at(of_buildings, buildings, pulls[:, :, None] * slopes[:, None, _EAST_NORTH])
    return np.asarray(variance + _PLACE_M**2 * np.einsum("kai,kbi->ab", of_buildings, of_buildings))


# Poses of a round, even, and how many rounds there are.
_POSES, _ROUNDS = 128, 12
# Draws lie a little wider than what they stand for, and part of each round's width stays from the one before:
# tails that no draw reaches are lost.
_WIDTH, _KEPT = 1.1, 0.3
# The share of the nats that counts in the first draw, the least, and how exactly its logarithm is found.
_FIRST_SHARE, _LEAST_SHARE, _SHARE_STEP = 0.25, 0.05, 0.01
_PLACE = slice(0, 3)
# The least difference of places, as a share of them.
_EPSILON = 8.881784197001252e-16
# The least variance: what is known exactly, as the tilt of priors of the true one.
_LEAST_SQUARE = 1e-18


class _Proposal(NamedTuple):
    """A Gaussian that poses are drawn from, by its axes.

    Attributes:
        mean: (D,).
        axes: (D, D) its own, a column each.
        deviations: (D,) along them.
    """

    mean: Floats
    axes: Floats
    deviations: Floats

    @classmethod
    def of(cls, mean: Floats, covariance: Floats) -> _Proposal:
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
    log_likelihood: Callable[[Floats, float], Floats],
    log_prior: Callable[[Floats], Floats],
    vector: Floats,
    covariance: Floats,
    least_m: float,
) -> Floats:
    """Returns the mean of the posterior around a point, (D,): a pose, and what else is not known.

    Eq. (R16) of docs/methods/region.md.

    By adaptive multiple importance sampling: poses are drawn from a Gaussian, the next Gaussian is that of
    all poses so far, and each weighs what the posterior is there over the mean density of all Gaussians
    (Cornuet et al., "Adaptive multiple importance sampling", 2012; docs/adr/0011, point 10).
    The likelihood is tempered as far as the place needs to be ``least_m`` wide.

    Args:
        log_likelihood: (N, D) points and a share to the (N,) log-likelihood of such a share of the
            photo's evidence, up to a constant of that share.
        log_prior: (N, D) points to the (N,) logarithm of their prior, up to a constant.
        vector: (D,) the best point.
        covariance: (D, D) how far the mean may be from it.
        least_m: Least deviation of the place, over its three numbers together, metres.
    """
    # The same draws for every query: the answer is a function of photo, prior and map.
    generator = random_stream(0, "posterior mean of the region fit")
    mean, spread, share = vector, covariance, _FIRST_SHARE
    gaussians: list[_Proposal] = []
    poses, whole, priors = np.zeros((0, len(vector))), np.zeros(0), np.zeros(0)
    for _ in range(_ROUNDS):
        gaussians.append(_Proposal.of(mean, _WIDTH**2 * spread))
        drawn = gaussians[-1].drawn(generator)
        poses = np.concatenate([poses, drawn])
        # Against the best point at the same share: what a share alone adds is no pose's (docs/adr/0011,
        # point 10).
        *logs, level = log_likelihood(np.concatenate([drawn, vector[None]]), share) / share
        whole = np.append(whole, np.array(logs) - level)
        priors = np.append(priors, log_prior(drawn))
        rest = priors - scipy.special.logsumexp(
            [gaussian.log_density(poses) for gaussian in gaussians], axis=0
        )
        share = _share_that_leaves(least_m, poses, whole, rest)
        mean, own = _moments(poses, share * whole + rest)
        spread = _KEPT * spread + (1.0 - _KEPT) * own
    return mean


def _share_that_leaves(least_m: float, poses: Floats, log_likelihood: Floats, rest: Floats) -> float:
    """Returns which share of the nats leaves the place so wide, metres; all where they do.

    Eq. (R17) of docs/methods/region.md.
    """

    def excess(log_share: float) -> float:
        _, covariance = _moments(poses, math.exp(log_share) * log_likelihood + rest)
        return math.sqrt(float(np.trace(covariance[_PLACE, _PLACE]))) - least_m

    least = math.log(_LEAST_SHARE)
    if excess(0.0) >= 0.0:
        return 1.0
    return math.exp(_root(excess, least, 0.0, _SHARE_STEP)) if excess(least) > 0.0 else _LEAST_SHARE


def _root(value: Callable[[float], float], low: float, high: float, step: float) -> float:
    """Returns where a function that changes its sign between two places is 0, to a step (Brent 1973, ch. 4).

    As ``scipy.optimize.brentq`` has it, whose import takes a sixth of a second.
    """
    before, now = (low, value(low)), (high, value(high))
    beyond, last = before, high - low
    moved = last
    while True:
        if (before[1] < 0.0) != (now[1] < 0.0):
            beyond, last = before, now[0] - before[0]
            moved = last
        if abs(beyond[1]) < abs(now[1]):
            before, now, beyond = now, beyond, now
        least, half = 0.5 * (step + _EPSILON * abs(now[0])), 0.5 * (beyond[0] - now[0])
        if now[1] == 0.0 or abs(half) < least:
            return now[0]
        tried = math.inf
        if abs(last) > least and abs(now[1]) < abs(before[1]):
            tried = _interpolated(before, now, beyond)
        if 2.0 * abs(tried) < min(abs(last), 3.0 * abs(half) - least):
            last, moved = moved, tried
        else:
            last = moved = half
        before = now
        place = now[0] + (moved if abs(moved) > least else math.copysign(least, half))
        now = place, value(place)


def _interpolated(
    before: tuple[float, float], now: tuple[float, float], beyond: tuple[float, float]
) -> float:
    """Returns how far from the present place (x, y) a line, or a hyperbola through three, is 0."""
    rise = (before[1] - now[1]) / (before[0] - now[0])
    if before[0] == beyond[0]:
        return -now[1] * (now[0] - before[0]) / (now[1] - before[1])
    other = (beyond[1] - now[1]) / (beyond[0] - now[0])
    return -now[1] * (beyond[1] * other - before[1] * rise) / (other * rise * (beyond[1] - before[1]))


def _moments(poses: Floats, logs: Floats) -> tuple[Floats, Floats]:
    """Returns mean (D,) and covariance (D, D) of poses of some weights, given by logarithms."""
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    mean = weights @ poses
    away = poses - mean
    return mean, (away.T * weights) @ away
