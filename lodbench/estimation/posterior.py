"""The posterior of the pose: its mean, its covariance, and what errors of the map add to that.

The answer is the posterior's mean, not its maximum: the objective has steps below a pixel, and ridges along
which the effects of tilt and position cancel. Its maximum is one of many local ones, metres apart on a
ridge; the mean is nearer to the truth (docs/adr/0011, point 9).

The likelihood is tempered by an exponent that depends on the photo (docs/adr/0013, point 2): hundreds of
lines seem to fix a position to a decimetre, but their errors are correlated.

The curvature of a likelihood is the information of a photo on the pose if the map is right. Buildings of
maps are half a metre off, and their roofs higher or lower, each outline as a whole: few buildings constrain
a pose less than thousands of their pixels suggest (docs/adr/0013, point 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.estimation.outline_alignment import OWN_BASE, OWN_ROOF, OutlinePoints
from lodbench.estimation.state_vector import FOCAL, POSE, Gaussian
from lodbench.kernels import error_covariance
from lodbench.storage import random_stream

Floats = NDArray[np.float64]

# Number of poses that the quadratic is fitted to; one of six numbers has 28 coefficients.
_NUM_DRAWS = 192
_PAIRS = np.triu_indices(6)


def information_at(log_likelihood: Callable[[Floats], Floats], near: Gaussian) -> Floats:
    """Returns the information (6, 6) of the likelihood at a mode: that of the photo if the map is right.

    Eq. (R18) of docs/methods/region.md. A quadratic is fitted to the (N,) log-likelihood of (N, 6) poses
    drawn from a Gaussian about the mode. Directions in which it has no maximum have no information.
    """
    roots = near.root()
    # The same draws for every query: the answer is a function of the mode alone.
    draws = random_stream(0, "curvature of the region fit").standard_normal((_NUM_DRAWS // 2, 6))
    draws = np.concatenate([draws, -draws])
    values = log_likelihood(near.mean + draws @ roots.T)
    design = np.column_stack([np.ones(len(draws)), draws, draws[:, _PAIRS[0]] * draws[:, _PAIRS[1]]])
    coefficients = np.linalg.lstsq(design, values, rcond=None)[0]
    hessian = np.zeros((6, 6))
    hessian[_PAIRS] = coefficients[7:]
    curvature, directions = np.linalg.eigh(-(hessian + hessian.T))
    back = np.linalg.inv(roots)
    information = back.T @ (directions * np.maximum(curvature, 0.0)) @ directions.T @ back
    return np.asarray(0.5 * (information + information.T))


def mode_probabilities(log_posteriors: Floats) -> Floats:
    """Returns (M,) the probabilities of some modes or hypotheses, given (M,) the log-posterior of each.

    Eq. (R13) of docs/methods/region.md, its second half, where modes are assumed to be equally wide.
    """
    weights = np.exp(log_posteriors - log_posteriors.max())
    return np.asarray(weights / weights.sum())


# Standard deviations of the map, metres: the position of a building, the height of its roof as a whole and by
# parts, of all roofs, of its base.
_POSITION_M, _ROOF_M, _PART_M, _ROOFS_M, _BASE_M = 0.5, 0.7, 0.7, 0.35, 0.1
# Standard deviations of a photo's outline, pixels of the fine size: correlated, and of each point.
_TOGETHER_PX, _OWN_PX = 1.0, 1.0
# Distances over which these errors, and those of parts of a roof, are correlated, pixels of the fine size.
_NEAR_PX, _PART_PX = 12.0, 20.0
_EAST_NORTH = slice(0, 2)
# The largest number of points that are used, and the least that a covariance is computed from.
_MOST_POINTS, _LEAST_POINTS = 600, 6
# Added to the outline's information, as a fraction of its mean eigenvalue, so that it can be inverted.
_REGULARIZATION = 1e-6


def covariance_under_map_errors(
    likelihood_information: Floats, prior_information: Floats, points: OutlinePoints, lens_percent: float
) -> Floats:
    """Returns the covariance (6, 6) of an answer's error, metres and degrees.

    Eq. (R19) of docs/methods/region.md.

    At an answer the slopes of likelihood and prior cancel; each error of the map changes the former as it
    moves the outline. The likelihood's information is taken as that of an outline whose pixels are worth the
    same, and the covariance is the sandwich of the posterior's information and the variance of the slope
    (White, "Maximum likelihood estimation of misspecified models", 1982).

    Args:
        likelihood_information: (6, 6) information of the photo if the map is right.
        prior_information: (6, 6) information of the prior.
        points: points of the outline at the answer, at the fine size.
        lens_percent: standard deviation of the focal length, percent.
    """
    if len(points) < _LEAST_POINTS:
        return np.asarray(np.linalg.inv(prior_information))
    # Each point that is used stands for those that are left out.
    stride = math.ceil(len(points) / _MOST_POINTS)
    lengths = points.lengths[::stride] * stride
    slopes = points.slopes()[::stride]
    pulls = slopes[:, POSE] * lengths[:, None]
    outline = pulls.T @ slopes[:, POSE]
    outline += _REGULARIZATION * np.trace(outline) / len(outline) * np.eye(len(outline))
    per_pixel = max(
        float(np.median(scipy.linalg.eigh(likelihood_information, outline, eigvals_only=True))), 0.0
    )
    variance = _variance_of_pulls(pulls, slopes, points.pixels[::stride], points.buildings[::stride])
    for column, sigma in ((OWN_ROOF, _ROOFS_M), (FOCAL, lens_percent)):
        of_all = pulls.T @ slopes[:, column]
        variance += sigma**2 * np.outer(of_all, of_all)
    posterior_information = per_pixel * outline + prior_information
    back = np.linalg.inv(posterior_information)
    covariance = back @ (posterior_information + per_pixel**2 * variance) @ back
    return np.asarray(0.5 * (covariance + covariance.T))


def _variance_of_pulls(pulls: Floats, slopes: Floats, pixels: Floats, buildings: NDArray[np.int64]) -> Floats:
    """Returns (6, 6) the variance, by map and photo, of the summed slopes of N points by the pose, (N, 6)."""
    lower = error_covariance(
        np.ascontiguousarray(pixels),
        np.ascontiguousarray(slopes[:, OWN_ROOF]),
        np.ascontiguousarray(slopes[:, OWN_BASE]),
        np.ascontiguousarray(buildings),
        (_TOGETHER_PX**2, _OWN_PX**2),
        (_NEAR_PX, _PART_PX),
        (_ROOF_M**2, _PART_M**2, _BASE_M**2),
    )
    # einsum: sums of BLAS depend on the number of its threads.
    half = np.einsum("ia,ib->ab", pulls, np.einsum("ij,jb->ib", lower, pulls))
    own = np.einsum("ia,i,ib->ab", pulls, np.diagonal(lower), pulls)
    variance = half + half.T - own
    # A displaced building moves in the picture as for the opposite displacement of the camera.
    of_buildings = np.zeros((int(buildings.max()) + 1, 6, 2))
    np.add.at(of_buildings, buildings, pulls[:, :, None] * slopes[:, None, _EAST_NORTH])
    return np.asarray(variance + _POSITION_M**2 * np.einsum("kai,kbi->ab", of_buildings, of_buildings))


# Number of draws of a round, even, and of rounds.
_NUM_DRAWS_PER_ROUND, _NUM_ROUNDS = 128, 12
# The variance of proposals over that of all draws, and the fraction of the former covariance that is kept:
# tails that no draw reaches would be lost.
_VARIANCE_INFLATION, _KEPT = 1.1**2, 0.3
# The tempering exponent of the first round, the least one, and the precision of its logarithm.
_FIRST_TEMPER, _LEAST_TEMPER, _LOG_TEMPER_STEP = 0.25, 0.05, 0.01
_POSITION = slice(0, 3)
# The least relative difference of abscissae.
_EPSILON = 8.881784197001252e-16
# The least variance of a proposal: of what is known exactly, as a tilt that is declared true.
_LEAST_VARIANCE = 1e-18


class _Proposal(NamedTuple):
    """A Gaussian that poses are drawn from: mean (D,), axes (D, D) by column, deviations (D,) along them."""

    mean: Floats
    axes: Floats
    axis_sigmas: Floats

    @classmethod
    def of(cls, mean: Floats, covariance: Floats) -> _Proposal:
        squares, axes = np.linalg.eigh(covariance)
        return cls(mean, axes, np.sqrt(np.maximum(squares, _LEAST_VARIANCE)))

    def drawn(self, generator: np.random.Generator) -> Floats:
        """Returns the poses of a round, each with its mirror image, (N, D)."""
        half = generator.standard_normal((_NUM_DRAWS_PER_ROUND // 2, len(self.mean)))
        # The symmetric root does not depend on the signs that LAPACK gives axes.
        return self.mean + np.concatenate([half, -half]) @ ((self.axes * self.axis_sigmas) @ self.axes.T)

    def log_density(self, poses: Floats) -> Floats:
        """Returns the (N,) log-density at poses, up to a constant that all Gaussians share."""
        away = (poses - self.mean) @ self.axes / self.axis_sigmas
        return np.asarray(-0.5 * (away**2).sum(axis=1) - np.log(self.axis_sigmas).sum())


def posterior_mean(
    log_likelihood: Callable[[Floats, float], Floats],
    log_prior: Callable[[Floats], Floats],
    vector: Floats,
    covariance: Floats,
    least_m: float,
) -> Floats:
    """Returns the mean of the posterior near a point, (D,): a pose, and other numbers that are estimated.

    Eq. (R16) of docs/methods/region.md, by adaptive multiple importance sampling (Cornuet et al., "Adaptive
    multiple importance sampling", 2012; docs/adr/0011, point 10). The likelihood is tempered until the
    position's standard deviation is ``least_m``.

    Args:
        log_likelihood: from (N, D) points and a tempering exponent to (N,), up to a constant per exponent.
        log_prior: from (N, D) points to their (N,) log-prior, up to a constant.
        vector: (D,) the best point.
        covariance: (D, D) covariance of the first proposal.
        least_m: root of the summed variances of x, y and z, metres, that is reached at least.
    """
    # The same draws for every query: the answer is a function of photo, prior and map.
    generator = random_stream(0, "posterior mean of the region fit")
    mean, proposal_covariance, temper = vector, covariance, _FIRST_TEMPER
    proposals: list[_Proposal] = []
    # Of all draws: log-likelihood by unit of the exponent, relative to the best point, and log-prior.
    poses, relative, priors = np.zeros((0, len(vector))), np.zeros(0), np.zeros(0)
    for _ in range(_NUM_ROUNDS):
        proposals.append(_Proposal.of(mean, _VARIANCE_INFLATION * proposal_covariance))
        drawn = proposals[-1].drawn(generator)
        poses = np.concatenate([poses, drawn])
        # Relative, since the constant depends on the exponent (docs/adr/0011, point 10).
        *logs, at_best = log_likelihood(np.concatenate([drawn, vector[None]]), temper) / temper
        relative = np.append(relative, np.array(logs) - at_best)
        priors = np.append(priors, log_prior(drawn))
        rest = priors - scipy.special.logsumexp([each.log_density(poses) for each in proposals], axis=0)
        temper = _temper_for_width(least_m, poses, relative, rest)
        mean, weighted = _moments(poses, temper * relative + rest)
        proposal_covariance = _KEPT * proposal_covariance + (1.0 - _KEPT) * weighted
    return mean


def _temper_for_width(least_m: float, poses: Floats, log_likelihood: Floats, rest: Floats) -> float:
    """Returns the largest tempering exponent, up to 1, at which the position is ``least_m`` wide.

    Eq. (R17) of docs/methods/region.md; the least exponent where none is.
    """

    def excess(log_temper: float) -> float:
        _, covariance = _moments(poses, math.exp(log_temper) * log_likelihood + rest)
        return math.sqrt(float(np.trace(covariance[_POSITION, _POSITION]))) - least_m

    least = math.log(_LEAST_TEMPER)
    if excess(0.0) >= 0.0:
        return 1.0
    return math.exp(_root(excess, least, 0.0, _LOG_TEMPER_STEP)) if excess(least) > 0.0 else _LEAST_TEMPER


def _root(value: Callable[[float], float], low: float, high: float, step: float) -> float:
    """Returns the root of a function between two abscissae of different sign, to a step (Brent 1973, ch. 4).

    The steps are those of ``scipy.optimize.brentq``, whose import takes a sixth of a second.
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
        abscissa = now[0] + (moved if abs(moved) > least else math.copysign(least, half))
        now = abscissa, value(abscissa)


def _interpolated(
    before: tuple[float, float], now: tuple[float, float], beyond: tuple[float, float]
) -> float:
    """Returns the distance from the present point to the root of a line, or a hyperbola through three."""
    rise = (before[1] - now[1]) / (before[0] - now[0])
    if before[0] == beyond[0]:
        return -now[1] * (now[0] - before[0]) / (now[1] - before[1])
    other = (beyond[1] - now[1]) / (beyond[0] - now[0])
    return -now[1] * (beyond[1] * other - before[1] * rise) / (other * rise * (beyond[1] - before[1]))


def _moments(poses: Floats, logs: Floats) -> tuple[Floats, Floats]:
    """Returns mean (D,) and covariance (D, D) of poses (N, D), given (N,) logarithms of their weights."""
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    mean = weights @ poses
    away = poses - mean
    return mean, (away.T * weights) @ away
