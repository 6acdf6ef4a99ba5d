"""Rays through pixels of a camera, lens included, and how pixels move with the camera's parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import require_choice
from lodbench.geometry.camera import Camera
from lodbench.geometry.lens import distort

Floats = NDArray[np.float64]

# Parameters that a covariance may hold besides the six of the pose, and their units.
CAMERA_PARAMETERS = {"focal": "a share of both focal lengths", "cx": "px", "cy": "px", "k1": "1"}
# Newton's method: most steps, what counts as solved, and half the width of differences (normalised).
_STEPS, _SOLVED, _HALF = 60, 1e-10, 1e-6


class PixelRays(NamedTuple):
    """Rays through N pixels in camera axes: (x, y, 1); NaN where the lens shows no ray.

    Attributes:
        points: (N, 2) x and y.
        pixel_by_point: (N, 2, 2) how a pixel moves with its ray's x and y, pixels.
    """

    points: Floats
    pixel_by_point: Floats

    @property
    def point_by_pixel(self) -> Floats:
        """Returns (N, 2, 2) how a ray's x and y move with its pixel."""
        return _inverse(self.pixel_by_point)

    @property
    def directions(self) -> Floats:
        """Returns (N, 3) directions in camera axes, of length 1 along the optical axis."""
        return np.column_stack([self.points, np.ones(len(self.points))])


def pixel_rays(camera: Camera, pixels: Floats) -> PixelRays:
    """Returns the rays through (N, 2) pixels, COLMAP's convention (the first one's centre is 0.5, 0.5)."""
    focal = np.array([camera.fx, camera.fy])
    wanted = (np.asarray(pixels, dtype=np.float64) - [camera.cx, camera.cy]) / focal
    points = wanted.copy()
    slopes = np.broadcast_to(np.eye(2), (len(points), 2, 2))
    if camera.distortion:
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                slopes, off = _lens_slopes(camera, points), _through_lens(camera, points) - wanted
                points = points - (_inverse(slopes) @ off[:, :, None])[:, :, 0]
                if not (np.abs(off) > _SOLVED).any():
                    break
            slopes = _lens_slopes(camera, points)
            is_solved = (np.abs(_through_lens(camera, points) - wanted) < 1e3 * _SOLVED).all(axis=1)
            # Beyond where a polynomial folds back there are other roots, mirrored, which no ray takes.
            is_upright = (np.linalg.det(slopes) > 0) & (np.trace(slopes, axis1=1, axis2=2) > 0)
            points[~(is_solved & is_upright)] = np.nan
    return PixelRays(points, focal[:, None] * slopes)


def camera_columns(camera: Camera, rays: PixelRays, names: Sequence[str]) -> Floats:
    """Returns (N, 2, K) how the pixels of fixed rays move with K of ``CAMERA_PARAMETERS``.

    Raises:
        ConfigError: A name is not known.
    """
    for name in names:
        require_choice("parameters", name, CAMERA_PARAMETERS)
    count = len(rays.points)
    focal = np.array([camera.fx, camera.fy])
    radius2 = (rays.points**2).sum(axis=1, keepdims=True)
    columns = {
        "focal": focal * _through_lens(camera, rays.points),
        "cx": np.broadcast_to([1.0, 0.0], (count, 2)),
        "cy": np.broadcast_to([0.0, 1.0], (count, 2)),
        "k1": focal * rays.points * radius2,
    }
    return np.stack([columns[name] for name in names], axis=2) if names else np.zeros((count, 2, 0))


def _through_lens(camera: Camera, points: Floats) -> Floats:
    if not camera.distortion:
        return points
    return np.stack(distort(camera.lens, camera.distortion, points[:, 0], points[:, 1]), axis=1)


def _lens_slopes(camera: Camera, points: Floats) -> Floats:
    """Returns (N, 2, 2) derivatives of distorted coordinates by those of the ray, by differences."""
    steps = _HALF * np.eye(2)
    ahead = [_through_lens(camera, points + step) - _through_lens(camera, points - step) for step in steps]
    return np.stack(ahead, axis=2) / (2 * _HALF)


def _inverse(matrices: Floats) -> Floats:
    """Returns the inverses of (N, 2, 2) matrices; infinities where there is none."""
    (a, b), (c, d) = matrices[:, 0].T, matrices[:, 1].T
    adjoint = np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1)
    return np.asarray(adjoint / (a * d - b * c)[:, None, None])
