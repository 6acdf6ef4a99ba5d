"""Cast shadows: the scene's depth as the sun sees it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import Camera, Pose
from lodbench.kernels.looks import SunMap
from lodbench.rendering.raster import RasterRenderer

Floats = NDArray[np.float64]

# The sun as a camera this far away: its rays are parallel to within a hundredth of a degree per metre.
_DISTANCE_M = 60_000.0
# Beyond this distance from the middle of what is seen, nothing casts a shadow.
REACH_M = 450.0


_LEVEL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
# Nothing casts a shadow.
NO_SUN_MAP = SunMap(np.zeros((1, 1), dtype=np.float32), _LEVEL, (0.0, 0.0, 0.0), 1.0, 0.0)


def ground_in_view(camera: Camera, pose: Pose, low_m: float, high_m: float) -> Floats:
    """Returns places, (N, 3), where a view meets the lowest and the highest level of a scene.

    Nothing further than ``2 * REACH_M`` is among them: its shadows are too small to be seen.
    """
    share = np.linspace(0.0, 1.0, 9)
    u, v = (axis.ravel() for axis in np.meshgrid(share * camera.width, share * camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=1)
    rays = rays @ pose.rotation
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    drop = np.where(np.abs(rays[:, 2]) > 1e-6, rays[:, 2], 1e-6)
    distance = (np.array([[low_m], [high_m]]) - pose.center[2]) / drop
    distance = np.where(distance > 0, np.minimum(distance, 2.0 * REACH_M), 2.0 * REACH_M)
    points = (pose.center + rays * distance[..., None]).reshape(-1, 3)
    points[:, 2] = np.clip(points[:, 2], low_m, high_m)
    return np.asarray(points)


def draw_sun_map(raster: RasterRenderer, sun: Floats, seen: Floats, size: int) -> SunMap:
    """Returns the depth map, so many pixels wide, of the part of a scene that can be seen.

    The raster draws what casts shadows; ``sun``, (3,), leads towards the sun; ``seen``, (N, 3) local metres,
    are points that a picture shows.
    """
    rotation = _looking_along(-sun)
    middle = np.median(seen, axis=0)
    near = seen[np.linalg.norm(seen - middle, axis=1) <= REACH_M]
    plan = (near - middle) @ rotation.T
    radius = float(np.abs(plan[:, :2]).max()) + 2.0 if len(near) else 10.0
    center = middle + sun * _DISTANCE_M
    focal = 0.5 * size * _DISTANCE_M / radius
    camera = Camera(size, size, focal, focal, 0.5 * size, 0.5 * size)
    depth = raster.depth(camera, Pose.from_center(rotation, center))
    # Tuples, not arrays: the kernel would count references to arrays at every pixel.
    rows = tuple((float(x), float(y), float(z)) for x, y, z in rotation)
    x, y, z = (float(value) for value in center)
    return SunMap(depth, rows, (x, y, z), focal, 2.0 * radius / size)


def _looking_along(axis: Floats) -> Floats:
    """Returns the (3, 3) rotation of a camera that looks along a unit vector."""
    aside = np.array([0.0, 1.0, 0.0]) if abs(axis[2]) > 0.9 else np.array([0.0, 0.0, 1.0])
    right = np.cross(axis, aside)
    right /= np.linalg.norm(right)
    return np.ascontiguousarray(np.stack([right, np.cross(axis, right), axis]))
