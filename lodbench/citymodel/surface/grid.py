"""Surface models on square cells, read by windows: GeoTIFF, ASCII grids, folders of tiles of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import SURFACE_NO_DATA, SURFACE_STEP
from lodbench.citymodel.crs import resolve_crs
from lodbench.citymodel.terrain import (
    HIGHEST_M,
    LOWEST_M,
    Terrain,
    empty_grid,
    height_unit_m,
    read_ascii,
    read_band_m,
)
from lodbench.citymodel.vector.gdal import opened_raster, raster_driver
from lodbench.errors import CityModelError
from lodbench.findings import Findings

Floats = NDArray[np.float32]
Span = tuple[int, int]

RASTER_SUFFIXES = (".tif", ".tiff", ".asc")
LASER_SUFFIXES = (".laz", ".las")
# What a header may state: 32,768 cells a side, 8 km at 0.25 m.
_MAX_CELLS = 1 << 30
# Tiles may be off the common raster by so much of a cell, which is rounding.
_OFF_CELLS = 0.02
# Heights beside each other on the two sides of a border between tiles differ by more in the median: a step.
_STEP_M = 0.3
# Cells coarser than this show no building, metres.
_COARSEST_M = 5.0
# Cells read at a time, a side.
BLOCK = 2048


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


class _Tile(NamedTuple):
    """A raster file: its place, the cells it has, its reference system and metres per unit of it."""

    path: Path
    grid: Terrain
    shape: tuple[int, int]
    crs: str | None


def surface_files(path: Path) -> list[Path]:
    """Returns the files of a surface model: the path itself, or rasters and laser points in a folder."""
    if not path.is_dir():
        return [path]
    known = RASTER_SUFFIXES + LASER_SUFFIXES
    files = [file for file in sorted(path.rglob("*")) if file.suffix.lower() in known and file.is_file()]
    return [file for file in files if not file.name.startswith("._")]


def open_surface(path: Path, crs: str | None = None) -> SurfaceGrid:
    """Returns a surface model whose heights are read by windows; nothing but headers is read yet.

    Args:
        path: GeoTIFF, ASCII grid, LAS or LAZ, or a folder of tiles of one of these kinds.
        crs: Reference system instead of the one it names.

    Raises:
        CityModelError: It is missing, unreadable, turned, in degrees, too large or too coarse, its tiles do
            not fit together, or what reads it is not installed.
    """
    files = surface_files(path)
    if not path.exists() or not files:
        raise CityModelError(f"There is no surface model at {path}.", "It is a .tif, .asc, .laz or a folder.")
    kinds = {file.suffix.lower() in LASER_SUFFIXES for file in files}
    if len(kinds) > 1:
        raise CityModelError(f"{path} holds rasters and laser points.", "Put them into folders of their own.")
    if kinds.pop():
        from lodbench.citymodel.surface.laser import rasterised_points

        return rasterised_points(files, str(path), crs)
    return _mosaic([_tile(file, crs) for file in files], str(path))


def _tile(path: Path, crs: str | None) -> _Tile:
    if not path.is_file():
        raise CityModelError(f"There is no surface model at {path}.", "Check the path.")
    if path.suffix.lower() == ".asc":
        ascii_grid = _ascii(path)
        return _Tile(path, ascii_grid, ascii_grid.heights.shape, crs)
    with opened_raster(path, raster_driver(path)) as raster:
        if raster.dtypes[0].startswith("complex"):
            raise CityModelError(f"{path} holds complex numbers, no heights.", "Take the surface model.")
        own = crs if crs is not None or raster.crs is None else raster.crs.to_wkt()
        return _Tile(path, empty_grid(raster.transform, path), raster.shape, own)


@lru_cache(maxsize=4)
def _ascii(path: Path) -> Terrain:
    return read_ascii(path)


def _mosaic(tiles: Sequence[_Tile], name: str) -> SurfaceGrid:
    """Returns tiles of one raster as a grid."""
    first = tiles[0]
    cell = (first.grid.cell_x, first.grid.cell_y)
    for tile in tiles:
        if tile.crs != first.crs and _plane(tile.crs) != _plane(first.crs):
            raise CityModelError(
                f"{tile.path} and {first.path} are in different reference systems.", "Warp them to one."
            )
        if not np.allclose((tile.grid.cell_x, tile.grid.cell_y), cell, rtol=1e-6):
            raise CityModelError(
                f"{tile.path} and {first.path} have cells of different sizes.", "Warp them: gdalwarp -tr."
            )
    west, north = min(t.grid.west for t in tiles), max(t.grid.north for t in tiles)
    exact = np.array([[(north - t.grid.north) / cell[1], (t.grid.west - west) / cell[0]] for t in tiles])
    starts = np.rint(exact).astype(np.int64)
    off = np.abs(exact - starts).max(axis=1)
    if off.max() > _OFF_CELLS:
        raise CityModelError(
            f"{tiles[int(off.argmax())].path} lies {off.max():.2f} cells off the raster of the other tiles.",
            "Warp them to one raster: gdalwarp -tap -tr.",
        )
    ends = starts + [t.shape for t in tiles]
    rows, columns = (int(side) for side in ends.max(axis=0))
    grid = SurfaceGrid(
        name, first.crs, west, north, cell, plane_unit_m(first.crs, name), (rows, columns),
        read=lambda rows, columns: _read_tiles(tiles, starts, rows, columns),
        borders=(
            tuple(sorted({int(row) for row in starts[:, 0]} - {0})),
            tuple(sorted({int(column) for column in starts[:, 1]} - {0})),
        ),
    )  # fmt: skip
    require_size(grid)
    return grid


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


def _plane(crs: str | None) -> object:
    known = None if crs is None else resolve_crs(crs)
    return crs if known is None else known.horizontal


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


def _read_tiles(tiles: Sequence[_Tile], starts: NDArray[np.int64], rows: Span, columns: Span) -> Floats:
    """Returns heights of a window; where tiles overlap, those of the first that has any."""
    heights = np.full((rows[1] - rows[0], columns[1] - columns[0]), np.nan, np.float32)
    for tile, (top, left) in zip(tiles, starts.tolist(), strict=True):
        own_rows = max(rows[0] - top, 0), min(rows[1] - top, tile.shape[0])
        own_columns = max(columns[0] - left, 0), min(columns[1] - left, tile.shape[1])
        if own_rows[0] >= own_rows[1] or own_columns[0] >= own_columns[1]:
            continue
        found = _read_tile(tile, own_rows, own_columns)
        part = heights[
            own_rows[0] + top - rows[0] : own_rows[1] + top - rows[0],
            own_columns[0] + left - columns[0] : own_columns[1] + left - columns[0],
        ]
        np.copyto(part, found, where=np.isnan(part))
    return heights


def _read_tile(tile: _Tile, rows: Span, columns: Span) -> NDArray[np.float64]:
    if tile.path.suffix.lower() == ".asc":
        heights_m = _ascii(tile.path).heights[slice(*rows), slice(*columns)] * height_unit_m(tile.crs)
    else:
        with opened_raster(tile.path, raster_driver(tile.path)) as raster:
            heights_m = read_band_m(raster, tile.crs, rows, columns)
    is_land = (heights_m > LOWEST_M) & (heights_m < HIGHEST_M)
    return np.where(is_land, heights_m, np.nan)


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
        findings.add(SURFACE_NO_DATA, grid.name, share)


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
                findings.add(
                    SURFACE_STEP, grid.name, f"{np.median(jumps):+.2f} m at {word} {border}, between tiles"
                )


def height_step_m(heights: Floats) -> float:
    """Returns the step in which heights are written: 1 for whole metres; 0 for less than 0.1 m."""
    known = np.unique(heights[np.isfinite(heights)][::7])
    if len(known) < 3:
        return 0.0
    step = float(min(after - before for before, after in pairwise(known.tolist())))
    return step if step > 0.099 else 0.0
