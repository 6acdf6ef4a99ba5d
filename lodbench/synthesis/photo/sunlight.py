"""Cast shadows: the scene's depth as the sun sees it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import Camera, Pose
from lodbench.rendering.compiled import per_pixel
from lodbench.rendering.raster import RasterRenderer
from lodbench.synthesis.photo.noise import dot, plus

Floats = NDArray[np.float64]

# The sun as a camera this far away: its rays are parallel to within a hundredth of a degree per metre.
_DISTANCE_M = 60_000.0
# Beyond this distance from the middle of what is seen, nothing casts a shadow.
REACH_M = 450.0


class SunMap(NamedTuple):
    """Depth towards the sun, for the kernel."""

    depth: NDArray[np.float32]  # (N, N) float32 metres from the map's camera; 0 where there is nothing
    rotation: tuple[tuple[float, float, float], ...]  # (3, 3) sun_from_world
    center: tuple[float, float, float]  # (3,) of the camera, local metres
    focal: float  # focal length, pixels
    texel_m: float  # size of a map pixel on the scene


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


@per_pixel
def sun_share(point, normal, facing, sun_map):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns how much of the sun reaches a point, (3,) local metres, 0 to 1: four map pixels, weighted.

    The normal, (3,), is on the camera's side; ``facing`` is the cosine between it and the sun, above 0.
    """
    # Off the surface by a map pixel and more where light grazes it: it must not shade itself.
    push = sun_map.texel_m * (0.6 + 0.8 * (1.0 - facing))
    c, r = sun_map.center, sun_map.rotation
    way = plus(plus(point, normal, push), c, -1.0)
    depth = dot(r[2], way)
    size = sun_map.depth.shape[0]
    scale = sun_map.focal / depth
    u = dot(r[0], way) * scale + 0.5 * size - 0.5
    v = dot(r[1], way) * scale + 0.5 * size - 0.5
    i, j = np.int64(np.floor(u)), np.int64(np.floor(v))
    if i < 0 or j < 0 or i >= size - 1 or j >= size - 1:
        return 1.0
    bias = depth - 0.08 - 0.5 * sun_map.texel_m
    fu, fv = u - i, v - j
    lit = 0.0
    for row in range(2):
        for column in range(2):
            first = sun_map.depth[j + row, i + column]
            if first == 0.0 or first >= bias:
                lit += (fu if column else 1.0 - fu) * (fv if row else 1.0 - fv)
    return lit
