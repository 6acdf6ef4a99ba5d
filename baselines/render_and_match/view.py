"""Views of the map, rendered to be matched."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.geometry import Camera, Pose

Floats = NDArray[np.float64]

# A light from above and aside, so that no two walls of a corner are of one grey.
_LIGHT = np.array([0.35, 0.5, 0.79])
_DARK, _RANGE, _BACKGROUND = 70.0, 170.0, 60
# Directions of the further views, in the order they are added: right, left, ahead, back, then between.
_BESIDE = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1))


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A rendered view.

    Attributes:
        camera: Its pinhole.
        pose: Where it was drawn from, scene frame.
        picture: (H, W, 3) uint8 RGB.
        depth: (H, W) float32 along the optical axis, metres; 0 where there is nothing.
    """

    camera: Camera
    pose: Pose
    picture: NDArray[np.uint8]
    depth: NDArray[np.float32]


def canvas_camera(camera: Camera, share: float) -> Camera:
    """Returns the pinhole of a larger picture round the same one: more is in view, at the same scale."""
    width, height = round(camera.width * share), round(camera.height * share)
    return replace(
        camera,
        width=width,
        height=height,
        cx=camera.cx + (width - camera.width) / 2,
        cy=camera.cy + (height - camera.height) / 2,
    )


def views_near(pose: Pose, count: int, spread_m: float) -> list[Pose]:
    """Returns a pose, then others of the same direction, beside it on the level, ahead being the camera's."""
    ahead = pose.rotation[1] * (1.0, 1.0, 0.0)
    # The picture's up, on the ground; towards the horizon for all cameras but one that looks at the nadir.
    ahead = -ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    right = np.array([ahead[1], -ahead[0], 0.0])
    poses = [pose]
    for number in range(count - 1):
        side, forward = _BESIDE[number % len(_BESIDE)]
        far = spread_m * (1 + number // len(_BESIDE))
        poses.append(pose.shifted(far * (side * right + forward * ahead)))
    return poses


def shaded_views(city_map: CityMap, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.uint8]:
    """Returns (N, H, W, 3) pictures of the untextured model, each face in the grey a light gives it."""
    normals = city_map.normals(camera, rotations, centers)
    # Half as bright on the side away from the light, so that there too faces differ.
    shade = 0.5 + 0.5 * (normals @ _LIGHT.astype(np.float32))
    # Channel by channel: several times as fast as `any` over a last axis of three.
    is_building = (normals[..., 0] != 0) | (normals[..., 1] != 0) | (normals[..., 2] != 0)
    grey = np.where(is_building, _DARK + _RANGE * shade, _BACKGROUND).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)
