"""Who stands where: the town's plans on a fine grid, to ask many places at once."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.shapes import Points

NOBODY = 0
_CELL_M = 0.5
# Sub-cell precision of the fill, as a power of two.
_SHIFT = 4


class Occupancy:
    """A grid over a square around the town's middle; cells hold 1 + the number of whoever is there.

    Args:
        pieces: For each number from 0 its convex pieces of plan, (N, 2) metres.
        reach_m: Half the side of the square.
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
