"""Nearest hits by brute force: every ray against every triangle, in barycentric coordinates."""

from dataclasses import dataclass

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.kernels.raster_rule import NEAR_M

# Hits nearer to an edge than this share of the triangle, or to the next hit than this share of the
# depth, are not decided here.
_MARGIN = 1e-2


@dataclass
class Hits:
    """Depth (H, W) metres, triangle (H, W), and where both are beyond doubt."""

    depth: np.ndarray
    triangle: np.ndarray
    is_sure: np.ndarray


def cast_rays(scene: Scene, camera: Camera, pose: Pose) -> Hits:
    """Returns the nearest hit of the ray through each pixel's centre."""
    corners = (scene.vertices.astype(np.float64) - pose.center)[scene.triangles] @ pose.rotation.T
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    rays = np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.ones((len(y), len(x)))], axis=2)
    depth = np.full((len(corners), len(y), len(x)), np.inf)
    doubt = np.zeros((len(y), len(x)), dtype=bool)
    for t, (a, b, c) in enumerate(corners):
        # weights @ corners = depth * ray, so the weights of (ray / depth) sum to 1 / depth.
        matrix = np.array([a, b, c]).T
        if abs(np.linalg.det(matrix)) < 1e-9:
            doubt[:] = True
            continue
        weights = rays @ np.linalg.inv(matrix).T
        total = weights.sum(axis=2)
        share = (weights / np.where(total == 0, 1, total)[..., None]).min(axis=2)
        z = 1 / np.where(total == 0, 1e-12, total)
        depth[t] = np.where((share > 0) & (z > NEAR_M), z, np.inf)
        doubt |= (np.abs(share) < _MARGIN) & (z > 0)
    ordered = np.sort(depth, axis=0)
    hit = np.isfinite(ordered[0])
    gap = ordered[1] - np.where(hit, ordered[0], 0)
    is_sure = ~doubt & hit & (gap > _MARGIN * np.where(hit, ordered[0], 0)) & (ordered[0] > 1.01 * NEAR_M)
    return Hits(ordered[0], depth.argmin(axis=0), is_sure)
