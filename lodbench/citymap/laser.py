"""A laser's range to the photo's centre: its residual, and places of pixels updated by it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap.linear_places import LinearPlaces, Uncertainty, linearized_places
from lodbench.citymap.surfaces import Surfaces
from lodbench.geometry import Camera, Pose
from lodbench.photos.xmp import LaserRange

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
