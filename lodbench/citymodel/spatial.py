"""Where buildings are: boxes, and a grid over the plan that finds those in a window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.raw import starts_of
from lodbench.citymodel.scene import Scene

_CELL_M = 100.0  # a town block: a few dozen buildings per cell
_MAX_CELLS = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class SpatialIndex:
    """Boxes of buildings and the cells of a grid they touch.

    Attributes:
        boxes: (B, 6) float32: lower then upper corner, metres; empty buildings are NaN.
        grid: (4,) float64: west, south, cell size, columns.
        cell_starts: (C + 1,) int64 offsets into ``cell_buildings``, row by row from the south-west.
        cell_buildings: int32 building numbers.
    """

    boxes: NDArray[np.float32]
    grid: NDArray[np.float64]
    cell_starts: NDArray[np.int64]
    cell_buildings: NDArray[np.int32]

    def within(self, west: float, south: float, east: float, north: float) -> NDArray[np.int64]:
        """Returns the buildings whose boxes touch a window of the plan, ascending.

        Args:
            west: West side of the window, metres in the scene's frame.
            south: South side.
            east: East side.
            north: North side.
        """
        origin_x, origin_y, size, columns = self.grid
        num_columns = int(columns)
        num_rows = (len(self.cell_starts) - 1) // num_columns
        x = np.clip(np.floor((np.array([west, east]) - origin_x) / size), 0, num_columns - 1).astype(int)
        y = np.clip(np.floor((np.array([south, north]) - origin_y) / size), 0, num_rows - 1).astype(int)
        found = [
            self.cell_buildings[
                self.cell_starts[row * num_columns + x[0]] : self.cell_starts[row * num_columns + x[1] + 1]
            ]
            for row in range(y[0], y[1] + 1)
        ]
        candidates = np.unique(np.concatenate(found)).astype(np.int64)
        box = self.boxes[candidates]
        touches = (box[:, 0] <= east) & (box[:, 3] >= west) & (box[:, 1] <= north) & (box[:, 4] >= south)
        return candidates[touches]


def index_scene(scene: Scene) -> SpatialIndex:
    """Returns the index of a scene.

    Args:
        scene: At least one building must have a vertex.
    """
    count = scene.num_buildings
    boxes = np.full((count, 6), np.nan, np.float32)
    filled = np.flatnonzero(np.diff(scene.vertex_starts) > 0)
    first = scene.vertex_starts[filled]
    boxes[filled, :3] = np.minimum.reduceat(scene.vertices, first, axis=0)
    boxes[filled, 3:] = np.maximum.reduceat(scene.vertices, first, axis=0)
    low = boxes[filled, :2].min(axis=0).astype(np.float64)
    span = boxes[filled, 3:5].max(axis=0) - low
    size = max(_CELL_M, float(np.sqrt(max(span[0] * span[1], 1.0) / _MAX_CELLS)), float(span.max()) / 2**14)
    columns, rows = (int(length // size) + 1 for length in span)
    from_cell = np.floor((boxes[filled, :2] - low) / size).astype(np.int64)
    to_cell = np.floor((boxes[filled, 3:5] - low) / size).astype(np.int64)
    wide = to_cell - from_cell + 1
    counts = wide[:, 0] * wide[:, 1]
    owner = np.repeat(np.arange(len(filled)), counts)
    step = np.arange(len(owner)) - starts_of(counts)[owner]
    column = from_cell[owner, 0] + step % wide[owner, 0]
    row = from_cell[owner, 1] + step // wide[owner, 0]
    cell = row * columns + column
    order = np.argsort(cell, kind="stable")
    return SpatialIndex(
        boxes=boxes,
        grid=np.array([low[0], low[1], size, columns]),
        cell_starts=starts_of(np.bincount(cell, minlength=columns * rows)),
        cell_buildings=filled[owner[order]].astype(np.int32),
    )
