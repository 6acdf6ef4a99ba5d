"""Points on the map's edges as far as a pose sees them: what is laid over the photo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.geometry import Camera, Pose

Floats = NDArray[np.float64]

# The view is widened by so much: the prior is wrong, and what lies beyond its rim may be in the photo.
_CANVAS = 1.25


def visible_points(
    city_map: CityMap,
    camera: Camera,
    pose: Pose,
    spacing_m: float,
    most: int,
    generator: np.random.Generator,
) -> Floats:
    """Returns (N, 3) points on the edges that a pose sees, scene metres; none where it sees no building.

    Args:
        city_map: Draws the edges.
        camera: Pinhole at the size that visibility is decided at.
        pose: From where.
        spacing_m: Greatest distance between neighbours on an edge; ends are always taken.
        most: At most so many points, chosen at random where there are more.
        generator: Chooses them.
    """
    wide = wider(camera, _CANVAS)
    view = city_map.edges(wide, pose.rotation[None], pose.center[None])[0]
    points = points_along(view.points[view.is_visible], spacing_m)
    if len(points) > most:
        points = points[np.sort(generator.choice(len(points), most, replace=False))]
    return points


def points_along(segments: Floats, spacing_m: float) -> Floats:
    """Returns (N, 3) points on (S, 2, 3) segments, ends included, no further apart than a spacing."""
    along = segments[:, 1] - segments[:, 0]
    steps = np.maximum(1, np.ceil(np.sqrt((along * along).sum(axis=1)) / spacing_m)).astype(np.int64)
    owner = np.repeat(np.arange(len(segments)), steps + 1)
    first = np.repeat(np.cumsum(steps + 1) - (steps + 1), steps + 1)
    share = (np.arange(len(owner)) - first) / steps[owner]
    return np.asarray(segments[owner, 0] + share[:, None] * along[owner])


def wider(camera: Camera, share: float) -> Camera:
    """Returns the pinhole of a picture so many times as wide and high round the same one."""
    width, height = round(camera.width * share), round(camera.height * share)
    across, down = (width - camera.width) / 2, (height - camera.height) / 2
    return replace(camera, width=width, height=height, cx=camera.cx + across, cy=camera.cy + down)
