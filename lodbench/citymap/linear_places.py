"""Places of pixels as linear functions of the errors of pose, camera, pixel and surface: to first order.

A pixel's ray starts at the camera and turns with it; where it meets a surface, the surface's own error moves
the place along the ray.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import LodbenchError
from lodbench.geometry import Camera, Pose
from lodbench.geometry.angles import turning_axes
from lodbench.geometry.camera import camera_columns, pixel_rays
from lodbench.rendering.surfaces import Hits, Surfaces

Floats = NDArray[np.float64]

# How well a pixel is pointed at, a standard deviation along each axis, pixels.
PIXEL_SIGMA_PX = 1.0
# 95 % of chi-square with two degrees of freedom: on a surface, and on the map.
CHI2_95 = 5.991464547107979


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """How well a pose, its camera and pixels are known: as of ``locate``.

    Raises:
        LodbenchError: The covariance is of another shape, not finite or no covariance, or the pixel's sigma
            is no positive number.
    """

    covariance: Floats | None
    parameters: tuple[str, ...] = ()
    pixel_sigma_px: float = PIXEL_SIGMA_PX

    def __post_init__(self) -> None:
        if not (math.isfinite(self.pixel_sigma_px) and self.pixel_sigma_px >= 0):
            raise LodbenchError(f"A pixel's sigma of {self.pixel_sigma_px} px is no length.")
        if self.covariance is None:
            return
        matrix, size = np.asarray(self.covariance, dtype=np.float64), 6 + len(self.parameters)
        if matrix.shape != (size, size):
            raise LodbenchError(
                f"The covariance is of shape {matrix.shape}, not {(size, size)}.",
                "Six rows are of the pose; further ones are named by parameters.",
            )
        if not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T, rtol=1e-6):
            raise LodbenchError("The covariance is not finite, or not symmetric.")
        if np.linalg.eigvalsh(matrix).min() < -1e-6 * np.abs(matrix).max():
            raise LodbenchError("The covariance has a negative eigenvalue.")


@dataclass(frozen=True, slots=True, eq=False)
class LinearPlaces:
    """N places as linear functions of errors: of pose and camera, of the pixel, of the surface.

    Attributes:
        hits: What the rays meet.
        rays: (N, 3) directions in the scene's frame.
        by_ray: (N, 3, 6 + K) how points at these distances on the rays move with pose and camera.
        by_ray_pixel: (N, 3, 2) likewise with the pixel.
        onto: (N, 3, 3) projection along the ray onto the surface.
        by_surface: (N, 3) how the place moves with the surface along its normal.
    """

    hits: Hits
    rays: Floats
    by_ray: Floats
    by_ray_pixel: Floats
    onto: Floats
    by_surface: Floats

    @property
    def jacobian(self) -> Floats:
        """Returns (N, 3, 6 + K) how the places move with pose and camera."""
        return np.asarray(self.onto @ self.by_ray)

    def covariances(self, known: Uncertainty) -> Floats:
        """Returns (N, 3, 3) of the places."""
        assert known.covariance is not None  # noqa: S101 - the caller has looked
        jacobian, pixel = self.jacobian, self.onto @ self.by_ray_pixel
        surface = (self.hits.sigma_m[:, None] * self.by_surface)[:, :, None]
        spread = jacobian @ known.covariance @ jacobian.transpose(0, 2, 1)
        spread += known.pixel_sigma_px**2 * pixel @ pixel.transpose(0, 2, 1)
        return np.asarray(spread + surface @ surface.transpose(0, 2, 1))


def linearized_places(
    surfaces: Surfaces, camera: Camera, pose: Pose, pixels: Floats, parameters: Sequence[str] = ()
) -> LinearPlaces:
    """Returns the places that (N, 2) pixels show, and how they move; NaN for those that show none."""
    rays = pixel_rays(camera, pixels)
    world = rays.directions @ pose.rotation
    hits = surfaces.hit(pose.center, world)
    depths = ((hits.places - pose.center) @ pose.rotation[2])[:, None, None]
    axes = np.radians(turning_axes(pose.euler))  # per degree
    turned = np.cross(axes[None], world[:, None]).transpose(0, 2, 1)
    by_pixel = depths * (pose.rotation[:2].T @ rays.point_by_pixel)
    # A parameter that moves the image of a fixed ray moves the ray of a fixed pixel the other way.
    by_camera = -by_pixel @ camera_columns(camera, rays, parameters)
    by_center = np.broadcast_to(np.eye(3), (len(pixels), 3, 3))
    by_ray = np.concatenate([by_center, depths * turned, by_camera], axis=2)
    along = (hits.normals * world).sum(axis=1)[:, None]
    by_surface = world / along
    onto = np.eye(3) - by_surface[:, :, None] * hits.normals[:, None]
    return LinearPlaces(hits, world, by_ray, by_pixel, onto, by_surface)


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
