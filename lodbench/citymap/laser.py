"""A laser's range to the photo's centre: what speaks for rough poses by it, and a pose updated by it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.citymap.places import MOST_SIGMAS, LaserResidual, LinearPlaces, at_centre, laser_residual
from lodbench.geometry import Camera, Pose
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.photos.xmp import LaserRange
from lodbench.rendering.surfaces import Surfaces
from lodbench.storage import random_stream

if TYPE_CHECKING:
    from lodbench.citymap.city_map import CityMap
    from lodbench.datasets.query import Query

Floats = NDArray[np.float64]

# How often a beam meets what the map has not (a tree, a car, a crane), and how far off its range is then.
_ELSEWHERE, _ELSEWHERE_M = 0.1, 200.0
# A pose that is still to be refined is off by so much along the ray: a standard deviation, metres.
_ROUGH_M = 2.0
# Poses that are drawn to ask which surface the beam meets, even; the surface that is taken holds this share
# of what speaks for any.
_DRAWS, _CLEAR = 48, 0.9


def range_log_densities(query: Query, city_map: CityMap, vectors: Floats) -> Floats:
    """Returns (N,) the logarithm of the density of a query's range at rough poses, (N, 6) or longer; or 0.

    Eq. (M9) of docs/methods/index.md.
    """
    laser, log_densities = None if query.measured is None else query.measured.laser, np.zeros(len(vectors))
    if laser is None:
        return log_densities
    surfaces, camera = city_map.surfaces, query.camera
    for row, vector in enumerate(vectors):
        pose = pose_from_vector(vector[:6])
        residual = laser_residual(at_centre(surfaces, camera, pose), pose, laser)
        elsewhere = math.log(_ELSEWHERE / _ELSEWHERE_M)
        if residual is None:
            log_densities[row] = elsewhere
            continue
        sigma = math.hypot(residual.sigma_m, _ROUGH_M)
        met = _log_normal(residual.residual_m, sigma) + math.log(1.0 - _ELSEWHERE)
        log_densities[row] = np.logaddexp(met, elsewhere)
    return log_densities


class RangedPose(NamedTuple):
    """A pose after a range."""

    vector: Floats  # (6,) metres and degrees, scene frame
    kept: Floats | None  # (6, 6) what is left of an error of before; None where the range was not used
    noise: Floats  # (6, 6) what the range itself errs by adds to its covariance
    note: str  # what became of the range, in a sentence

    def left_of(self, covariance: Floats) -> Floats:
        """Returns (6, 6) what is left of a covariance of before the range."""
        if self.kept is None:
            return covariance
        left = self.kept @ covariance @ self.kept.T + self.noise
        return np.asarray(0.5 * (left + left.T))


class _Met(NamedTuple):
    centre: LinearPlaces
    residual: LaserResidual
    innovation_m: float
    variance: float
    log_density: float


def pose_by_range(
    surfaces: Surfaces, camera: Camera, pose: Pose, covariance: Floats, laser: LaserRange
) -> RangedPose:
    """Returns a pose updated by a range as a Kalman filter does, if it is plain which surface was met.

    Eq. (M10) of docs/methods/index.md.

    The pose's error may lead the ray beside the surface that the beam has met: poses around it are asked.
    A range that contradicts the pose, or may be to one of two surfaces, moves nothing.

    Args:
        surfaces: The map's.
        camera: Of the photo.
        pose: In the scene's frame.
        covariance: (6, 6) of its error, metres and degrees.
        laser: The range measured.
    """
    vector = vector_from_pose(pose)

    def unused(reason: str) -> RangedPose:
        said = f"the laser measured {laser.range_m:.1f} m to the photo's centre, {reason}: not used"
        return RangedPose(vector, None, np.zeros((6, 6)), said)

    # The nearest first: of draws that meet one surface it says best how the range changes.
    draws = [_met(surfaces, camera, vector, away, covariance, laser) for away in _drawn(covariance)]
    known = [each for each in draws if each is not None]
    if not known:
        return unused("where map and pose show no surface")
    likeliest = max(known, key=lambda each: each.log_density).centre.hits
    same = [each for each in known if each.centre.hits.is_same(0, likeliest, 0)]
    best, logs = same[0], [each.log_density for each in known]
    sigmas = abs(best.innovation_m) / math.sqrt(best.variance)
    if sigmas > MOST_SIGMAS:
        expected = laser.range_m + best.innovation_m
        return unused(f"map and pose say {expected:.1f} m, {sigmas:.1f} sigma apart")
    whole = scipy.special.logsumexp(logs)
    if scipy.special.logsumexp([each.log_density for each in same]) - whole < math.log(_CLEAR):
        return unused("and may have met one of two surfaces")
    jacobian = best.residual.jacobian
    gain = covariance @ jacobian / best.variance
    moved = vector - gain * best.innovation_m
    note = f"the laser's range of {laser.range_m:.1f} m to the {best.centre.hits.kind[0]} was used"
    noise = best.residual.sigma_m**2 * np.outer(gain, gain)
    return RangedPose(moved, np.eye(6) - np.outer(gain, jacobian), noise, note)


def _drawn(covariance: Floats) -> Floats:
    """Returns (49, 6) errors drawn from a covariance, none among them, the likeliest first."""
    half = random_stream(0, "surfaces that a beam may meet").standard_normal((_DRAWS // 2, 6))
    half = half[np.argsort((half**2).sum(axis=1), kind="stable")]
    squares, axes = np.linalg.eigh(covariance)
    # The symmetric root: it does not depend on the signs that a library of linear algebra gives axes.
    aside = half @ ((axes * np.sqrt(np.maximum(squares, 0.0))) @ axes.T)
    return np.concatenate([np.zeros((1, 6)), np.stack([aside, -aside], axis=1).reshape(-1, 6)])


def _met(
    surfaces: Surfaces, camera: Camera, vector: Floats, away: Floats, covariance: Floats, laser: LaserRange
) -> _Met | None:
    """Returns how a range agrees with the surface that a pose so far away shows; None where that is none."""
    pose = pose_from_vector(vector + away)
    centre = at_centre(surfaces, camera, pose)
    residual = laser_residual(centre, pose, laser)
    if residual is None:
        return None
    # Of the pose itself, by this surface.
    innovation = residual.residual_m - float(residual.jacobian @ away)
    variance = float(residual.jacobian @ covariance @ residual.jacobian) + residual.sigma_m**2
    prior = -0.5 * float(away @ np.linalg.pinv(covariance, hermitian=True) @ away)
    return _Met(centre, residual, innovation, variance, prior + _log_normal(innovation, math.sqrt(variance)))


def _log_normal(away: float, sigma: float) -> float:
    return -0.5 * (away / sigma) ** 2 - math.log(sigma * math.sqrt(2.0 * math.pi))
