"""The box around each building of a scene: where its base is, and what is clear of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene

Floats = NDArray[np.float64]


class BuildingBoxes(NamedTuple):
    """Boxes along the axes around buildings; those without triangles are left out.

    Attributes:
        low: (B, 3) least coordinates, local metres.
        high: (B, 3) greatest coordinates.
        building: (B,) number of each in the scene.
    """

    low: Floats
    high: Floats
    building: NDArray[np.int64]

    @property
    def bases(self) -> Floats:
        """Returns the middle of each building's base, (B, 3) local metres."""
        return np.column_stack([0.5 * (self.low[:, :2] + self.high[:, :2]), self.low[:, 2]])

    def are_clear_of(self, center: Floats, clearance_m: float) -> bool:
        """Returns whether a camera centre, (3,), keeps a distance from every box, sideways and above."""
        below = center[2] < self.high[:, 2] + clearance_m
        off = np.maximum(self.low[:, :2] - center[:2], center[:2] - self.high[:, :2])
        return not bool((below & (off < clearance_m).all(axis=1)).any())


def building_boxes(scene: Scene) -> BuildingBoxes:
    """Returns the boxes around a scene's buildings."""
    filled = np.flatnonzero(np.diff(scene.vertex_starts) > 0)
    # Empty buildings own no vertices, so the starts of the others still bound them.
    starts, points = scene.vertex_starts[filled], scene.vertices.astype(np.float64)
    return BuildingBoxes(np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts), filled)


def floors_and_rises(scene: Scene) -> tuple[Floats, Floats]:
    """Returns (B,) the lowest height of each building, and (B,) its height from there, metres; else 0."""
    low, high, building = building_boxes(scene)
    floors, rises = np.zeros((2, scene.num_buildings))
    floors[building], rises[building] = low[:, 2], high[:, 2] - low[:, 2]
    return floors, rises
