"""A laser's range to the photo's centre: its residual, and poses and places of pixels updated by it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.citymap.linear_places import LinearPlaces, Uncertainty, linearized_places
from lodbench.geometry import Camera, Pose
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.photos.xmp import LaserRange
from lodbench.rendering.surfaces import Surfaces
from lodbench.storage import random_stream

if TYPE_CHECKING:
    from lodbench.citymap.city_map import CityMap
    from lodbench.datasets.query import Query

Floats = NDArray[np.float64]

# Correlation length of a surface's errors, metres; a range whose residual is more standard deviations than
# this was measured to something else.
_CORRELATION_M, _MOST_SIGMAS = 30.0, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class LaserResidual:
    """How a laser's range disagrees with a pose.

    Attributes:
        residual_m: Range to the surface at the pose, less the range measured.
        jacobian: (6 + K,) of it by x, y, z (metres), pitch, roll, yaw (degrees) and the camera's parameters.
        sigma_m: Standard deviation of the residual at the true pose: of the laser and the surface.
        surface_m: The surface's part, signed: how much farther it is for one sigma along its normal.
    """

    residual_m: float
    jacobian: Floats
    sigma_m: float
    surface_m: float


def at_centre(surfaces: Surfaces, camera: Camera, pose: Pose, parameters: Sequence[str] = ()) -> LinearPlaces:
    """Returns the one place that the photo's centre shows, along whose ray a drone's laser measures.

    Args:
        surfaces: The map.
        camera: Of the photo.
        pose: In the scene's frame.
        parameters: As of ``locate``.
    """
    middle = np.array([[0.5 * camera.width, 0.5 * camera.height]])
    return linearized_places(surfaces, camera, pose, middle, parameters)


def laser_residual(centre: LinearPlaces, pose: Pose, laser: LaserRange) -> LaserResidual | None:
    """Returns how a range disagrees with a pose in the scene's frame; None where its ray meets nothing.

    Args:
        centre: Of that pose, from ``at_centre``.
        pose: In the scene's frame.
        laser: The range measured.
    """
    if not centre.hits.kind[0]:
        return None
    way = centre.hits.places[0] - pose.center
    ray = way / np.linalg.norm(way)
    jacobian = ray @ centre.jacobian[0]
    jacobian[:3] -= ray
    surface = float(centre.hits.sigma_m[0] * (ray @ centre.by_surface[0]))
    sigma = math.hypot(laser.sigma_m, surface)
    return LaserResidual(float(np.linalg.norm(way)) - laser.range_m, jacobian, sigma, surface)


def update_by_range(
    centre: LinearPlaces,
    pose: Pose,
    known: Uncertainty,
    laser: LaserRange,
    linear: LinearPlaces,
    places: Floats,
    covariances: Floats,
) -> list[str]:
    """Updates places on the surface that a range was measured to, in place, as a Kalman filter does.

    The range shares the pose's error with every place, and the surface's with places nearby.

    Args:
        centre: From ``at_centre``.
        pose: In the scene's frame.
        known: The pose's covariance, which must be there.
        laser: The range measured.
        linear: The N places before.
        places: (N, 3) those, scene frame.
        covariances: (N, 3, 3) of them, square metres.

    Returns:
        N sentences: why a range contradicts a place and was not used; "" where it does not.
    """
    residual, notes = laser_residual(centre, pose, laser), [""] * len(places)
    if residual is None:
        return notes
    assert known.covariance is not None  # noqa: S101 - the caller has looked
    pose_share = known.covariance @ residual.jacobian
    variance = float(residual.jacobian @ pose_share) + residual.sigma_m**2
    off = abs(residual.residual_m) / math.sqrt(variance)
    for row, kind in enumerate(linear.hits.kind):
        if not kind or not linear.hits.is_same(row, centre.hits, 0):
            continue
        if off > _MOST_SIGMAS:
            expected = laser.range_m + residual.residual_m
            notes[row] = (
                f"the laser measured {laser.range_m:.1f} m to the photo's centre, map and pose say "
                f"{expected:.1f} m, {off:.1f} sigma apart: not used"
            )
            continue
        away = float(np.linalg.norm(linear.hits.places[row] - centre.hits.places[0]))
        common = math.exp(-away / _CORRELATION_M) * residual.surface_m * linear.hits.sigma_m[row]
        shared = linear.jacobian[row] @ pose_share + common * linear.by_surface[row]
        places[row] -= shared * residual.residual_m / variance
        covariances[row] -= np.outer(shared, shared) / variance
    return notes


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
    laser, found = None if query.measured is None else query.measured.laser, np.zeros(len(vectors))
    if laser is None:
        return found
    surfaces, camera = city_map.surfaces, query.camera
    for row, vector in enumerate(vectors):
        pose = pose_from_vector(vector[:6])
        residual = laser_residual(at_centre(surfaces, camera, pose), pose, laser)
        elsewhere = math.log(_ELSEWHERE / _ELSEWHERE_M)
        if residual is None:
            found[row] = elsewhere
            continue
        sigma = math.hypot(residual.sigma_m, _ROUGH_M)
        met = _log_normal(residual.residual_m, sigma) + math.log(1.0 - _ELSEWHERE)
        found[row] = np.logaddexp(met, elsewhere)
    return found


class RangedPose(NamedTuple):
    """A pose after a range.

    Attributes:
        vector: (6,) metres and degrees, scene frame.
        kept: (6, 6) what is left of an error of before; None where the range was not used.
        noise: (6, 6) what the range itself errs by adds to its covariance.
        note: What became of the range, in a sentence.
    """

    vector: Floats
    kept: Floats | None
    noise: Floats
    note: str

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
    found = [_met(surfaces, camera, vector, away, covariance, laser) for away in _drawn(covariance)]
    known = [each for each in found if each is not None]
    if not known:
        return unused("where map and pose show no surface")
    likeliest = max(known, key=lambda each: each.log_density).centre.hits
    same = [each for each in known if each.centre.hits.is_same(0, likeliest, 0)]
    best, logs = same[0], [each.log_density for each in known]
    sigmas = abs(best.innovation_m) / math.sqrt(best.variance)
    if sigmas > _MOST_SIGMAS:
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
