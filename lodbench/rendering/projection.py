"""From world to screen, as the raster rule has it: camera axes, snapping, and what a view cannot see."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import RenderingError
from lodbench.geometry import Camera, Pose
from lodbench.kernels.raster_rule import GUARD_PX

Floats = NDArray[np.float64]


def require_pinhole(camera: Camera) -> None:
    """Makes sure that a camera can be rendered.

    Raises:
        RenderingError: The camera has lens distortion or is wider or higher than 8192 pixels.
    """
    if camera.distortion:
        raise RenderingError(
            "A city is rendered with a pinhole; this camera has lens distortion.",
            "Undistort the image and mask first, and give the pinhole's intrinsics.",
        )
    if max(camera.width, camera.height) > GUARD_PX:
        raise RenderingError(f"An image side is longer than {GUARD_PX:.0f} pixels.", "Scale the camera.")


def require_size(camera: Camera, size: tuple[int, int]) -> None:
    """Makes sure that a query of a width and height has the camera's.

    Raises:
        RenderingError: It has not.
    """
    if size != (camera.width, camera.height):
        raise RenderingError(
            f"The query mask is {size[0]} x {size[1]} pixels, the camera {camera.width} x {camera.height}.",
            "Scale the camera with Camera.scaled.",
        )


def require_poses(rotations: Floats, centers: Floats) -> tuple[Floats, Floats]:
    """Returns poses as contiguous float64 arrays, (N, 3, 3) and (N, 3), if they can be drawn.

    Raises:
        RenderingError: A value is not finite, or the shapes are others.
    """
    rotations = np.ascontiguousarray(rotations, dtype=np.float64)
    centers = np.ascontiguousarray(centers, dtype=np.float64)
    if rotations.ndim != 3 or rotations.shape[1:] != (3, 3) or centers.shape != (len(rotations), 3):
        raise RenderingError(
            f"Poses are rotations (N, 3, 3) and centres (N, 3), not {rotations.shape} and {centers.shape}."
        )
    fine = np.isfinite(rotations).all(axis=(1, 2)) & np.isfinite(centers).all(axis=1)
    if not fine.all():
        raise RenderingError(
            f"Pose {int(np.argmin(fine))} of {len(rotations)} has values that are not finite.",
            "Check what made it: an angle or a position is NaN or infinite.",
        )
    return rotations, centers


def pose_arrays(pose: Pose) -> tuple[Floats, Floats]:
    """Returns one pose as contiguous rotation (3, 3) and centre (3,), if it can be drawn.

    Raises:
        RenderingError: A value is not finite.
    """
    rotations, centers = require_poses(pose.rotation[None], pose.center[None])
    return rotations[0], centers[0]


def view_planes(camera: Camera, first: int, stop: int) -> Floats:
    """Returns (5, 3) inward unit normals, through the camera centre, of what columns first to stop see."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    # One pixel wider on every side, so that rounding never culls a covered pixel.
    left, right, top, bottom = first - 1.0, stop + 1.0, -1.0, camera.height + 1.0
    normals = np.array(
        [
            [0.0, 0.0, 1.0],
            [fx, 0.0, cx - left],
            [-fx, 0.0, right - cx],
            [0.0, fy, cy - top],
            [0.0, -fy, bottom - cy],
        ]
    )
    return np.asarray(normals / np.sqrt((normals * normals).sum(axis=1, keepdims=True)))
