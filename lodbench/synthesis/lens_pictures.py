"""Pictures as a lens with distortion shows them, from renderers that draw pinholes only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import Camera
from lodbench.geometry.lens import distort

# Each iteration leaves |k1| r^2 of the error, below 0.2 for lenses of drones.
_ITERATIONS = 30


def draw_through_lens(draw: Callable[[Camera], NDArray[Any]], lens: Camera) -> NDArray[Any]:
    """Returns (H, W, ...) what a lens shows of what ``draw`` returns for a pinhole.

    Drawn with as short a focal length as the lens's corners need. Labels and masks keep their values (nearest
    pixel), photos are interpolated linearly.

    Args:
        draw: Returns the picture of a pinhole, of its size; booleans, integers, or (H, W, 3) of a photo.
        lens: With or without distortion; without, its picture is returned as drawn.
    """
    if not lens.distortion:
        return draw(lens)
    columns, rows = np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5
    seen_x, seen_y = np.meshgrid((columns - lens.cx) / lens.fx, (rows - lens.cy) / lens.fy)
    ray_x, ray_y = _undistort(lens, seen_x, seen_y)
    axes = ((ray_x, seen_x), (ray_y, seen_y))
    reach = max(1.0, *(float(np.abs(ray).max() / np.abs(seen).max()) for ray, seen in axes))
    pinhole = replace(lens.without_distortion(), fx=lens.fx / reach, fy=lens.fy / reach)
    picture = draw(pinhole)
    x, y = pinhole.fx * ray_x + pinhole.cx, pinhole.fy * ray_y + pinhole.cy
    if picture.ndim == 2:
        row, column = np.clip(y.astype(int), 0, lens.height - 1), np.clip(x.astype(int), 0, lens.width - 1)
        return np.asarray(picture[row, column])
    import cv2

    # OpenCV counts from pixel centres, COLMAP from corners.
    at = (x - 0.5).astype(np.float32), (y - 0.5).astype(np.float32)
    return np.asarray(cv2.remap(picture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _undistort(lens: Camera, seen_x: NDArray[Any], seen_y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Returns the pinhole's normalised coordinates of the lens's, by fixed-point iteration."""
    x, y = seen_x, seen_y
    for _ in range(_ITERATIONS):
        distorted_x, distorted_y = distort(lens.lens, lens.distortion, x, y)
        x, y = x + seen_x - distorted_x, y + seen_y - distorted_y
    return x, y
