"""The reference renderer: the raster rule written out in numpy, slow and obvious.

It shares no code with the engine: each triangle is clipped, snapped and tested pixel by pixel by
counting crossings in exact integers.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.kernels.arguments import GUARD_PX, NEAR_M, SUBPIXELS
from lodbench.rendering.projection import pose_arrays

Points = NDArray[np.float64]


class ReferenceRenderer:
    """Renders silhouettes of a scene by testing every pixel of every triangle's bounding box."""

    name = "reference"

    def __init__(self, scene: Scene, threads: int | None = None) -> None:
        self.scene = scene

    def render(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) silhouette seen from a pose."""
        pose_arrays(pose)
        mask = np.zeros((camera.height, camera.width), dtype=np.bool_)
        points = _camera_axes(self.scene.vertices.astype(np.float64), pose)
        for triangle in self.scene.triangles:
            polygon = _clip(points[triangle], camera)
            for i in range(1, len(polygon) - 1):
                _fill(mask, _snap(polygon[[0, i, i + 1]], camera))
        return mask


def _camera_axes(points: Points, pose: Pose) -> Points:
    """Returns (N, 3) world points in camera axes: raster rule 1."""
    d = points - pose.center
    return np.stack([(r[0] * d[:, 0] + r[1] * d[:, 1]) + r[2] * d[:, 2] for r in pose.rotation], axis=1)


def _clip(polygon: Points, camera: Camera) -> Points:
    """Returns the part of a polygon in front of the near plane and inside the guard band: rule 2."""
    distances: list[Callable[[Points], Points]] = [
        lambda p: p[2] - NEAR_M,
        lambda p: GUARD_PX * p[2] + (camera.fx * p[0] + camera.cx * p[2]),
        lambda p: GUARD_PX * p[2] - (camera.fx * p[0] + camera.cx * p[2]),
        lambda p: GUARD_PX * p[2] + (camera.fy * p[1] + camera.cy * p[2]),
        lambda p: GUARD_PX * p[2] - (camera.fy * p[1] + camera.cy * p[2]),
    ]
    for distance in distances:
        ahead = distance(polygon.T)
        if (ahead >= 0).all():
            continue
        kept: list[Points] = []
        corners = zip(polygon, ahead, strict=True)
        next_corners = zip(np.roll(polygon, -1, axis=0), np.roll(ahead, -1), strict=True)
        for (a, da), (b, db) in zip(corners, next_corners, strict=True):
            if da >= 0:
                kept.append(a)
            if (da >= 0) != (db >= 0):
                kept.append(a + (da / (da - db)) * (b - a))
        polygon = np.array(kept).reshape(-1, 3)
    return polygon


def _snap(points: Points, camera: Camera) -> NDArray[np.int64]:
    """Returns (N, 2) projected corners in whole sub-pixels: rule 3."""
    inverse = 1.0 / points[:, 2]
    u = (camera.fx * points[:, 0]) * inverse + camera.cx
    v = (camera.fy * points[:, 1]) * inverse + camera.cy
    return np.floor(np.stack([u, v], axis=1) * SUBPIXELS + 0.5).astype(np.int64)


def _fill(mask: NDArray[np.bool_], corners: NDArray[np.int64]) -> None:
    """Sets the pixels whose centre an odd number of edges pass at or above: rule 4."""
    low = np.maximum(corners.min(axis=0) // SUBPIXELS, 0)
    high = np.minimum(corners.max(axis=0) // SUBPIXELS + 1, [mask.shape[1], mask.shape[0]])
    if (low >= high).any():
        return
    half = SUBPIXELS // 2
    x = np.arange(low[0], high[0])[None, :] * SUBPIXELS + half
    y = np.arange(low[1], high[1])[:, None] * SUBPIXELS + half
    inside = np.zeros((len(y), x.shape[1]), dtype=np.bool_)
    for (x0, y0), (x1, y1) in zip(corners, corners[[1, 2, 0]], strict=True):
        if x0 > x1:
            x0, y0, x1, y1 = x1, y1, x0, y0
        meets_column = (x0 <= x) & (x < x1)
        at_or_above = (y0 - y) * (x1 - x0) + (x - x0) * (y1 - y0) <= 0
        inside ^= meets_column & at_or_above
    mask[low[1] : high[1], low[0] : high[0]] |= inside
