"""The ground of the town, smooth hills on both sides of a river valley, and who stands where on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.shapes import Points, left_of

# Hills: wavelength and amplitude in metres of waves much longer than a block.
_WAVES_M = ((900.0, 6.0), (620.0, 4.2), (380.0, 1.8), (240.0, 0.6))
# Across the valley: the bed of the river, its banks, and where the hills have their full height again.
_BED_M, _BANK_M, _VALLEY_M = 13.0, 19.0, 190.0
_BANK_HEIGHT_M = 2.6
_WATER_DEPTH_M = 1.6


@dataclass(frozen=True, eq=False)
class Terrain:
    """Ground heights: a slope up from the river and a few long waves, sunk into a valley along it."""

    base_m: float  # height at the river before the waves, metres above sea level
    rise: float  # metres of rise per metre away from the river
    waves: Points  # (N, 4) rows of wave vector x, y (radians per metre), phase (radians), amplitude (m)
    river: Points  # (K, 2) its middle line, local metres
    water_m: float  # height of the water

    @classmethod
    def draw(cls, generator: np.random.Generator, river: Points, relief: float) -> Terrain:
        """Returns hills that rise by some 30 m from a river to the edge of town."""
        waves = []
        for wavelength, amplitude in _WAVES_M:
            turn, phase = generator.uniform(0, 2 * np.pi, 2)
            number = 2 * np.pi / wavelength
            waves.append([number * np.cos(turn), number * np.sin(turn), phase, relief * amplitude])
        rise = relief * float(generator.uniform(0.02, 0.03))
        dry = cls(float(generator.uniform(180.0, 260.0)), rise, np.array(waves), river, -np.inf)
        lowest = float(dry._hills(river, np.zeros(len(river))).min())
        return replace(dry, water_m=round(lowest - _BANK_HEIGHT_M - 1.0, 2))

    def height(self, points: Points) -> Points:
        """Returns the ground height, (N,) metres, at local positions, (N, 2); the river's is its bed's."""
        distance = self.river_distance(points)
        bank = self.water_m + _BANK_HEIGHT_M
        share = np.clip((distance - _BANK_M) / (_VALLEY_M - _BANK_M), 0.0, 1.0)
        share = share * share * (3.0 - 2.0 * share)
        hills = bank + share * np.maximum(self._hills(points, distance) - bank, 0.5)
        depth = np.clip((_BANK_M - distance) / (_BANK_M - _BED_M), 0.0, 1.0)
        return np.asarray(hills - depth * (_BANK_HEIGHT_M + _WATER_DEPTH_M))

    def on_ground(self, points: Points, above_m: float = 0.0) -> Points:
        """Returns positions, (N, 2), with the height of the ground and a little more, (N, 3)."""
        return np.column_stack([points, self.height(points) + above_m])

    def river_distance(self, points: Points) -> Points:
        """Returns the distance, (N,) metres, of positions, (N, 2), from the middle of the river.

        Measured across the river where they lie, which is exact beside it and near enough elsewhere: the
        river bends gently and never turns back.
        """
        axes, s, off, bend = self._course
        at, side = (points @ axes).T
        lateral = np.abs(side - np.interp(at, s, off))
        return np.asarray(lateral / np.hypot(1.0, np.interp(at, s, bend)))

    @cached_property
    def _course(self) -> tuple[Points, Points, Points, Points]:
        """The axes (2, 2) along and across the river, where on them it runs, and how steeply it bends."""
        along = self.river[-1] - self.river[0]
        along = along / np.linalg.norm(along)
        axes = np.stack([along, left_of(along)], axis=1)
        s, off = (self.river @ axes).T
        return axes, s, off, np.gradient(off, s)

    def _hills(self, points: Points, distance: Points) -> Points:
        """Returns the heights as if there were no valley."""
        phase = points @ self.waves[:, :2].T + self.waves[:, 2]
        # The slope ends beyond the town: nobody lives on a mountain.
        far = 600.0 * np.tanh(distance / 600.0)
        return np.asarray(self.base_m + self.rise * far + np.sin(phase) @ self.waves[:, 3])


NOBODY = 0
_CELL_M = 0.5
# Sub-cell precision of the fill, as a power of two.
_SHIFT = 4


class Occupancy:
    """A grid over a square around the town's middle; cells hold 1 + the number of whoever is there.

    Of each number from 0 the convex pieces of plan, (N, 2) metres, are given; the square reaches half its
    side.
    """

    def __init__(self, pieces: Sequence[Sequence[Points]], reach_m: float) -> None:
        self._reach_m = reach_m
        count = 2 * round(reach_m / _CELL_M)
        self._cells = np.zeros((count, count), np.int32)
        for number, rings in enumerate(pieces):
            for ring in rings:
                # Pixel centres have whole numbers in OpenCV.
                corners = (ring + reach_m) / _CELL_M - 0.5
                fixed = np.round(corners * (1 << _SHIFT)).astype(np.int32)
                cv2.fillConvexPoly(self._cells, fixed, number + 1, lineType=cv2.LINE_8, shift=_SHIFT)

    def at(self, points: Points) -> NDArray[np.int32]:
        """Returns (N,) who is at places, (N, 2) metres: 1 + a number, or `NOBODY`."""
        cells = np.floor((points + self._reach_m) / _CELL_M).astype(np.int64)
        inside = ((cells >= 0) & (cells < len(self._cells))).all(axis=1)
        found = np.full(len(points), NOBODY, np.int32)
        found[inside] = self._cells[cells[inside, 1], cells[inside, 0]]
        return found

    def is_free_around(self, points: Points, gap_m: float) -> NDArray[np.bool_]:
        """Returns (N,) whether nobody is within about a distance of places, (N, 2) metres."""
        ring = np.linspace(0, 2 * np.pi, 8, endpoint=False)
        free = self.at(points) == NOBODY
        for x, y in gap_m * np.stack([np.cos(ring), np.sin(ring)], axis=1):
            free &= self.at(points + np.array([x, y])) == NOBODY
        return np.asarray(free)
