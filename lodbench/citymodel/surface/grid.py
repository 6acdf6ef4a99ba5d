"""Heights on a grid: terrain models, surface models that are read by windows, and what is checked of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import SURFACE_NO_DATA, SURFACE_STEP
from lodbench.citymodel.crs import resolve_crs
from lodbench.citymodel.model import HIGHEST_M, LOWEST_M
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.vector.gdal import opened_raster, raster_driver
from lodbench.errors import CityModelError
from lodbench.findings import Findings

_MAX_CELLS = 1 << 30
# What bands of rasters call their unit, metres; where they do not, it is that of their reference system.
_UNITS_M = {
    "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0, "ft": 0.3048, "foot": 0.3048,
    "feet": 0.3048, "us survey foot": 1200 / 3937, "us-ft": 1200 / 3937, "ftus": 1200 / 3937,
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Heights on a grid.

    Attributes:
        heights: (rows, columns) float64, north to south, in the raster's unit; NaN where there is none.
        west, north: Outer corner of the first cell.
        cell_x, cell_y: Size of a cell, both positive.
    """

    heights: NDArray[np.float64]
    west: float
    north: float
    cell_x: float
    cell_y: float

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns (N,) heights at points (N, 2): those of the cells they lie in, NaN outside."""
        rows, columns = self.heights.shape
        column = np.floor((points[:, 0] - self.west) / self.cell_x)
        row = np.floor((self.north - points[:, 1]) / self.cell_y)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        heights = np.full(len(points), np.nan)
        heights[inside] = self.heights[row[inside].astype(int), column[inside].astype(int)]
        return heights


def ground_under(points: NDArray[np.float64], crs: str, options: ReadOptions) -> NDArray[np.float64]:
    """Returns (N,) terrain heights under points given as easting or longitude first; NaN where there is none.

    Args:
        points: (N, 2) in ``crs``.
        crs: Their reference system, in whose unit of height the answer is; that of an ASCII grid, too.
        options: ``terrain`` names the raster.

    Raises:
        CityModelError: The raster cannot be read.
    """
    path = Path(str(options.terrain))
    if not path.is_file():
        raise CityModelError(f"There is no terrain model at {path}.", "Check the path.")
    unit_m = height_unit_m(crs)
    if path.suffix.lower() == ".asc":
        heights_m = read_ascii(path).at(points) * unit_m
    else:
        heights_m = _raster_heights_m(path, points, crs)
    return np.where((heights_m > LOWEST_M) & (heights_m < HIGHEST_M), heights_m / unit_m, np.nan)


def height_unit_m(crs: str | None) -> float:
    """Returns metres per unit of height of a reference system; 1 for one that is not known."""
    known = None if crs is None else resolve_crs(crs)
    return 1.0 if known is None else known.height_unit_m


def _raster_heights_m(path: Path, points: NDArray[np.float64], crs: str) -> NDArray[np.float64]:
    """Returns (N,) heights of a raster in metres; only the part of it under the points is read."""
    instead = "Or convert the raster to an ASCII grid (.asc)."
    with opened_raster(path, raster_driver(path), instead) as raster:
        grid = empty_grid(raster.transform, path)
        own_crs = crs if raster.crs is None else raster.crs.to_wkt()
        if raster.crs is not None:
            points = _projected(points, crs, own_crs)
        rows, columns = _window(grid, points, raster.shape)
        if (rows[1] - rows[0]) * (columns[1] - columns[0]) > _MAX_CELLS:
            raise CityModelError(f"{path} has too many cells under the city.", "Warp it to larger cells.")
        heights_m = read_band_m(raster, own_crs, rows, columns)
    part = replace(
        grid,
        heights=heights_m,
        west=grid.west + columns[0] * grid.cell_x,
        north=grid.north - rows[0] * grid.cell_y,
    )
    return part.at(points)


def read_band_m(
    raster: Any, crs: str | None, rows: tuple[int, int], columns: tuple[int, int]
) -> NDArray[np.float64]:
    """Returns a window of a raster's first band as heights in metres, NaN where there is none.

    Scale and offset of the band count; so does its unit, and where it names none that of the system.

    Args:
        raster: As ``opened_raster`` yields it.
        crs: Its reference system.
        rows: First and last (not included).
        columns: Likewise.
    """
    unit_m = _UNITS_M.get(str(raster.units[0]).strip().lower()) or height_unit_m(crs)
    band = raster.read(1, window=(rows, columns), masked=True)
    heights: NDArray[np.float64] = band.astype(np.float64).filled(np.nan)
    heights_m: NDArray[np.float64] = (heights * raster.scales[0] + raster.offsets[0]) * unit_m
    return heights_m


def empty_grid(step: Any, path: Path) -> Terrain:
    """Returns the place and the cells of a raster, without heights, by its affine transform.

    Raises:
        CityModelError: It has none, or is turned.
    """
    if step.is_identity:
        raise CityModelError(
            f"The raster {path} does not say where it lies; a world file beside it is not read.",
            "Put its place into it: gdal_translate -of GTiff FILE PLACED.tif",
        )
    if step.b or step.d or step.e >= 0:
        raise CityModelError(f"The raster {path} is turned.", "Warp it to north up (gdalwarp).")
    return Terrain(np.zeros((0, 0)), step.c, step.f, step.a, -step.e)


def _projected(points: NDArray[np.float64], crs: str, target: str) -> NDArray[np.float64]:
    from pyproj import Transformer

    transformer = Transformer.from_crs(crs, target, always_xy=True)
    return np.stack(transformer.transform(points[:, 0], points[:, 1]), axis=1)


def _window(
    grid: Terrain, points: NDArray[np.float64], shape: tuple[int, int]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Returns the first and last rows and columns of a grid that hold all the points it covers."""
    finite = points[np.isfinite(points).all(axis=1)]
    columns = np.floor((finite[:, 0] - grid.west) / grid.cell_x)
    rows = np.floor((grid.north - finite[:, 1]) / grid.cell_y)
    is_inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    if not is_inside.any():
        return (0, 1), (0, 1)
    rows, columns = rows[is_inside].astype(int), columns[is_inside].astype(int)
    return (int(rows.min()), int(rows.max()) + 1), (int(columns.min()), int(columns.max()) + 1)


def read_ascii(path: Path) -> Terrain:
    """Returns an ESRI ASCII grid; its reference system is taken to be that of the footprints."""
    header: dict[str, float] = {}
    try:
        with path.open(encoding="ascii") as stream:
            position = 0
            while (line := stream.readline()).split()[:1] and line.split()[0][0].isalpha():
                name, value = line.split()[:2]
                header[name.lower()] = float(value)
                position = stream.tell()
            shape = int(header["nrows"]), int(header["ncols"])
            if not 0 < shape[0] * shape[1] <= _MAX_CELLS:
                raise ValueError("the size is out of range")
            cells = [header.get(name) or header["cellsize"] for name in ("dx", "dy")]
            placing = [value for name, value in header.items() if name != "nodata_value"]
            if not all(map(math.isfinite, placing)) or min(cells) <= 0:
                raise ValueError("its place is not finite, or its cells have no size")
            stream.seek(position)
            heights = np.array(stream.read().split(), dtype=np.float64).reshape(shape)
    except (OSError, ValueError, KeyError, OverflowError) as error:
        raise CityModelError(
            f"{path} is no ASCII grid ({error}).", "It begins with ncols and nrows."
        ) from None
    heights[heights == header.get("nodata_value", -9999.0)] = np.nan
    width, height = cells
    west = header.get("xllcorner", header.get("xllcenter", 0.0) - 0.5 * width)
    south = header.get("yllcorner", header.get("yllcenter", 0.0) - 0.5 * height)
    return Terrain(heights, west, south + shape[0] * height, width, height)


Floats = NDArray[np.float32]
Span = tuple[int, int]

# What a header may state: 32,768 cells a side, 8 km at 0.25 m.
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
