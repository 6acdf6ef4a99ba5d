"""Heights of roofs, part by part: unknowns that all photos of a flight share.

A map of a low level of detail has one height where a roof has many, so a building is cut by a grid into
parts, each with a height of its own around its building's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# More cells than a city is wide, or high; a building's number times its square is one.
_MOST_CELLS = 1 << 20


class RoofParts:
    """The parts that photos have shown so far, numbered in the order they were met.

    Attributes:
        heights_m: (N,) by how much each is higher than in the map, metres.
        building: (N,) row of the scene's building it belongs to.
        drawn_m: (B,) by how much each building of the scene is drawn higher than the map has it, metres.

    Args:
        cell_m: Width of a part, metres.
        buildings: Number of the scene's buildings.
    """

    def __init__(self, cell_m: float, buildings: int) -> None:
        self._cell_m = cell_m
        self.drawn_m: Floats = np.zeros(buildings)
        self._numbers: dict[int, int] = {}
        self.heights_m: Floats = np.zeros(0)
        self.building: NDArray[np.int64] = np.zeros(0, dtype=np.int64)

    def untouched(self) -> RoofParts:
        """Returns the same with no part met."""
        return RoofParts(self._cell_m, len(self.drawn_m))

    def __len__(self) -> int:
        return len(self.building)

    def numbers_of(self, buildings: NDArray[np.int64], places: Floats) -> NDArray[np.int64]:
        """Returns the numbers of the parts that points lie in, (N,); new parts are as high as their building.

        Args:
            buildings: (N,) rows of the scene.
            places: (N, 2) east and north, scene metres.
        """
        cells = np.floor(places / self._cell_m).astype(np.int64) + _MOST_CELLS // 2
        # One number for building and cell: of few points in many photos, it is the sorting that takes long.
        keys, inverse = np.unique(
            (buildings * _MOST_CELLS + cells[:, 0]) * _MOST_CELLS + cells[:, 1], return_inverse=True
        )
        found = keys.tolist()
        new = [key for key in found if key not in self._numbers]
        if new:
            self._numbers.update(zip(new, range(len(self), len(self) + len(new)), strict=True))
            owners = np.array(new, dtype=np.int64) // _MOST_CELLS**2
            heights = [self._height_of(building) for building in owners.tolist()]
            self.building = np.concatenate([self.building, owners])
            self.heights_m = np.concatenate([self.heights_m, heights])
        numbers = np.array([self._numbers[key] for key in found], dtype=np.int64)
        return numbers[inverse]

    def building_heights(self) -> Floats:
        """Returns (B,) the mean height of each building's parts against the map, metres; 0 without any."""
        is_roof = self.building >= 0
        rows, heights = self.building[is_roof], self.heights_m[is_roof]
        counts = np.bincount(rows, minlength=len(self.drawn_m))
        return np.asarray(np.bincount(rows, heights, len(self.drawn_m)) / np.maximum(counts, 1))

    def _height_of(self, building: int) -> float:
        same = self.heights_m[self.building == building]
        return float(same.mean()) if len(same) else 0.0
