"""From pixels of a rendered view to points of the world, by the view's depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import Camera, Pose

Floats = NDArray[np.float64]

# Where four neighbouring depths differ by more than this share, an edge lies between them.
_STEP = 0.05


def lift(
    depth: NDArray[np.float32], camera: Camera, pose: Pose, pixels: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Returns the points of the world that pixels of a view show, and which of them have one.

    Args:
        depth: (H, W) along the optical axis, metres; 0 where there is nothing.
        camera: The view's pinhole.
        pose: The view's.
        pixels: (N, 2) COLMAP pixels.

    Returns:
        (N, 3) metres, and (N,) whether all four depths around the pixel are there and of one surface.
    """
    height, width = depth.shape
    places = np.clip(pixels - 0.5, 0.0, (width - 1.001, height - 1.001))
    column, row = np.floor(places).astype(np.int64).T
    u, v = (places - np.stack([column, row], axis=1)).T
    depths = np.stack(
        [depth[row, column], depth[row, column + 1], depth[row + 1, column], depth[row + 1, column + 1]]
    )
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
    z = (weights * depths).sum(axis=0)
    has_depth = (depths.min(axis=0) > 0) & (depths.max(axis=0) <= (1 + _STEP) * depths.min(axis=0))
    rays = np.stack(
        [(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(z))],
        axis=1,
    )
    return (rays * z[:, None]) @ pose.rotation + pose.center, has_depth
