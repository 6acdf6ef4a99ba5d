"""How far an estimated pose puts pixels on the map or the ground from where the true one does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap.linear_places import CHI2_95, Uncertainty, linearized_places
from lodbench.geometry import Camera, Pose
from lodbench.geometry.rays import pixel_rays
from lodbench.rendering.surfaces import Surfaces

Floats = NDArray[np.float64]

# Two places of a pixel are compared with at least this standard deviation: surfaces of the ground bend.
_LEAST_M = 0.05


class GroundErrors(NamedTuple):
    """Places of N pixels by an estimated pose, against those by the true one.

    Attributes:
        distance_m: (N,) between the two; NaN where either shows no place.
        is_within: (N,) whether the true one lies in the 95 % ellipse of the other, on its surface.
        surface: N names of what the estimate has them on: roof, wall or ground; "" for nothing.
    """

    distance_m: Floats
    is_within: NDArray[np.bool_]
    surface: tuple[str, ...]


def ground_errors(
    camera: Camera,
    pose: Pose,
    covariance: NDArray[np.float64],
    truth: Pose,
    surfaces: Surfaces,
    pixels: NDArray[np.float64],
    parameters: Sequence[str] = (),
    true_camera: Camera | None = None,
) -> GroundErrors:
    """Returns how far an estimate puts pixels from where the truth does.

    Map, ground and pixels are the same of both, so that the ellipse is of the pose alone.

    Args:
        camera: Of the estimate.
        pose: The estimate, in the scene's frame.
        covariance: (6 + K, 6 + K) of it, as of ``locate``.
        truth: The true pose, in the scene's frame.
        surfaces: The map.
        pixels: (N, 2).
        parameters: As of ``locate``.
        true_camera: Where it is another than ``camera``.
    """
    linear = linearized_places(surfaces, camera, pose, pixels, parameters)
    true_rays = pixel_rays(true_camera or camera, pixels).directions @ truth.rotation
    off = surfaces.hit(truth.center, true_rays).places - linear.hits.places
    known = Uncertainty(covariance, tuple(parameters))
    spread = linear.jacobian @ np.asarray(known.covariance) @ linear.jacobian.transpose(0, 2, 1)
    weighted = np.linalg.solve(np.nan_to_num(spread) + _LEAST_M**2 * np.eye(3), off[:, :, None])[:, :, 0]
    is_within = (off * weighted).sum(axis=1) <= CHI2_95
    return GroundErrors(np.linalg.norm(off, axis=1), is_within, linear.hits.kind)
