"""Surface models as heights on a grid that are read by windows, and what is checked of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import SURFACE_NO_DATA, SURFACE_STEP
from lodbench.citymodel.crs import resolve_crs
from lodbench.citymodel.terrain import (
    height_unit_m,
)
from lodbench.errors import CityModelError
from lodbench.findings import Findings

Floats = NDArray[np.float32]
Span = tuple[int, int]

# What a header may state: 32,768 cells a side, 8 km at 0.25 m.
_MAX_CELLS = 1 << 30
# Heights beside each other on the two sides of a border between tiles differ by more in the median: a step.
_STEP_M = 0.3
# Cells coarser than this show no building, metres.
_COARSEST_M = 5.0
# Cells read at a time, a side.
BLOCK = 1024


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceGrid:
    """Heights on a grid of rows from north to south, read by windows.

    Attributes:
        name: For messages.
        crs: Reference system as pyproj understands it, or None.
        west, north: Outer corner of the first cell, in its unit.
        cell: Width and height of a cell, in its unit.
        unit_m: Metres per unit of the plane.
        shape: Rows and columns.
        read: Returns heights (rows, columns) in metres, NaN where there are none, of two spans of cells.
        read_ground: Likewise of the ground alone, where the source tells it apart; else None.
        read_plants: Likewise of what the source says is vegetation; else None.
        borders: Rows and columns at which tiles begin.
    """

    name: str
    crs: str | None
    west: float
    north: float
    cell: tuple[float, float]
    unit_m: float
    shape: tuple[int, int]
    read: Callable[[Span, Span], Floats]
    read_ground: Callable[[Span, Span], Floats] | None = None
    read_plants: Callable[[Span, Span], Floats] | None = None
    borders: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())

    @property
    def cell_m(self) -> float:
        """Returns the side of a cell in metres; of one that is no square the longer."""
        return max(self.cell) * self.unit_m

    @property
    def height_unit_m(self) -> float:
        """Returns metres per unit of height of the reference system, in which cities state heights."""
        return height_unit_m(self.crs)

    def places(self, columns: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns (N, 2) coordinates of places counted in cells from the north-western corner."""
        return np.column_stack([self.west + columns * self.cell[0], self.north - rows * self.cell[1]])

    def blocks(self, side: int = BLOCK) -> Iterator[tuple[Span, Span]]:
        """Yields spans of rows and columns that cover the grid."""
        for row in range(0, self.shape[0], side):
            for column in range(0, self.shape[1], side):
                yield (row, min(row + side, self.shape[0])), (column, min(column + side, self.shape[1]))


def require_size(grid: SurfaceGrid) -> None:
    """Makes sure that a grid can be worked on.

    Raises:
        CityModelError: It has too many cells, or such as show no building.
    """
    rows, columns = grid.shape
    if rows * columns > _MAX_CELLS:
        raise CityModelError(
            f"{grid.name} has {rows:,} x {columns:,} cells, more than {_MAX_CELLS:,}.",
            "Take the tiles you need, or larger cells: gdalwarp -tr 0.5 0.5.",
        )
    if grid.cell_m > _COARSEST_M:
        raise CityModelError(
            f"{grid.name} has cells of {grid.cell_m:.3g} m, which show no building.",
            f"Cells of {_COARSEST_M:g} m or less are read; 0.25 to 1 m is usual.",
        )


def epsg_label(wkt: str) -> str:
    """Returns a reference system by its EPSG codes, ``EPSG:25832+7837``; as it is where a part has none."""
    from pyproj import CRS

    whole = CRS.from_wkt(wkt)
    codes = [part.to_epsg() for part in whole.sub_crs_list or [whole]]
    return wkt if None in codes else f"EPSG:{'+'.join(map(str, codes))}"


def plane_unit_m(crs: str | None, name: str) -> float:
    """Returns metres per unit of a plane; 1 where its system is not known.

    Raises:
        CityModelError: Its coordinates are degrees.
    """
    known = None if crs is None else resolve_crs(crs)
    if known is None:
        return 1.0
    if known.horizontal.is_geographic:
        raise CityModelError(
            f"{name} is in degrees ({known.label}), whose cells are no squares.",
            "Warp it to metres: gdalwarp -t_srs EPSG:... (the UTM zone) -tr 0.5 0.5.",
        )
    return float(known.horizontal.axis_info[0].unit_conversion_factor)


def tell_gaps(grid: SurfaceGrid, missing: int, findings: Findings) -> None:
    """Adds a finding of cells without a height.

    Raises:
        CityModelError: No cell has one.
    """
    cells = math.prod(grid.shape)
    if missing >= cells:
        raise CityModelError(
            f"{grid.name} has no height in any cell.",
            "Is it the right tile? gdalinfo -stats says what it holds.",
        )
    if missing:
        share = f"{100.0 * missing / cells:.1f} % of {cells:,} cells"
        findings.add(SURFACE_NO_DATA, "", share)


def tell_steps(grid: SurfaceGrid, findings: Findings) -> None:
    """Adds a finding for each border between tiles over which heights jump, as where flights differ."""
    for axis, word in ((0, "row"), (1, "column")):
        for border in grid.borders[axis]:
            others = (0, grid.shape[1 - axis])
            both = [(border - 1, border + 1), others]
            heights = grid.read(*(both if axis == 0 else both[::-1]))
            first, second = heights if axis == 0 else heights.T
            jumps = (second - first)[np.isfinite(second - first)]
            if len(jumps) and abs(float(np.median(jumps))) > _STEP_M:
                findings.add(SURFACE_STEP, "", f"{np.median(jumps):+.2f} m at {word} {border}, between tiles")


def height_step_m(heights: Floats) -> float:
    """Returns the step in which heights are written: 1 for whole metres; 0 for less than 0.1 m."""
    known = np.unique(heights[np.isfinite(heights)][::7])
    if len(known) < 3:
        return 0.0
    step = float(min(after - before for before, after in pairwise(known.tolist())))
    return step if step > 0.099 else 0.0
