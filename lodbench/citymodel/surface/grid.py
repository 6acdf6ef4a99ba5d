"""Heights on a grid: terrain models, and surface models that are read by windows, from files of every kind.

GeoTIFF, ASCII grids, laser points, and folders of tiles of one of them (``open_surface``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import SURFACE_NO_DATA, SURFACE_STEP
from lodbench.citymodel.crs import resolve_crs
from lodbench.citymodel.model import HIGHEST_M, LOWEST_M
from lodbench.citymodel.options import SURFACE_SUFFIXES
from lodbench.citymodel.vector.gdal import opened_raster, raster_driver
from lodbench.errors import CityModelError
from lodbench.findings import Findings

# What a header may state: 32,768 cells a side, 8 km at 0.25 m.
MAX_CELLS = 1 << 30
# What bands of rasters call their unit, metres; where they do not, it is that of their reference system.
_UNITS_M = {
    "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0, "ft": 0.3048, "foot": 0.3048,
    "feet": 0.3048, "us survey foot": 1200 / 3937, "us-ft": 1200 / 3937, "ftus": 1200 / 3937,
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Heights on a grid."""

    # (rows, columns) float64, north to south, in the raster's unit; NaN where there is none
    heights: NDArray[np.float64]
    # Outer corner of the first cell
    west: float
    north: float
    # Size of a cell, both positive
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


def height_unit_m(crs: str | None) -> float:
    """Returns metres per unit of height of a reference system; 1 for one that is not known."""
    known = None if crs is None else resolve_crs(crs)
    return 1.0 if known is None else known.height_unit_m


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
            if not 0 < shape[0] * shape[1] <= MAX_CELLS:
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

# Heights beside each other on the two sides of a border between tiles differ by more in the median: a step.
_STEP_M = 0.3
# Cells coarser than this show no building, metres.
_COARSEST_M = 5.0
# Cells read at a time, a side.
BLOCK = 1024


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceGrid:
    """Heights on a grid of rows from north to south, read by windows."""

    name: str  # for messages
    crs: str | None  # reference system as pyproj understands it, or None
    # Outer corner of the first cell, in its unit
    west: float
    north: float
    cell: tuple[float, float]  # width and height of a cell, in its unit
    unit_m: float  # metres per unit of the plane
    shape: tuple[int, int]  # rows and columns
    # Returns heights (rows, columns) in metres, NaN where there are none, of two spans of cells
    read: Callable[[Span, Span], Floats]
    # Likewise of the ground alone, where the source tells it apart; else None
    read_ground: Callable[[Span, Span], Floats] | None = None
    # Likewise of what the source says is vegetation; else None
    read_plants: Callable[[Span, Span], Floats] | None = None
    borders: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())  # rows and columns at which tiles begin

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
    if rows * columns > MAX_CELLS:
        raise CityModelError(
            f"{grid.name} has {rows:,} x {columns:,} cells, more than {MAX_CELLS:,}.",
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


# ASPRS classes: ground; low, medium and high vegetation; low and high noise.
_GROUND, _PLANTS, _NOISE = (2,), (3, 4, 5), (7, 18)
_CHUNK = 2_000_000
# Widths of cells, metres: the narrowest that most cells of have a point.
_CELLS_M = (0.25, 0.5, 1.0, 2.0)
_POINTS_PER_CELL = 2.0
# Three rasters are held, so fewer cells than of a file that is read by windows.
_MAX_CELLS_HELD = 1 << 27


def rasterised_points(paths: Sequence[Path], name: str, crs: str | None) -> SurfaceGrid:
    """Returns laser points as a grid, held in memory; files are read in pieces.

    Args:
        paths: LAS or LAZ files of one reference system.
        name: For messages.
        crs: That system instead of the one they name.

    Raises:
        CityModelError: laspy is not installed, a file cannot be read, names no reference system that is
            known, or they spread too far.
    """
    heads = [_head(path) for path in paths]
    own = crs or heads[0][2]
    low = np.min([head[0] for head in heads], axis=0)
    high = np.max([head[1] for head in heads], axis=0)
    unit_m = plane_unit_m(own, name)
    area_m2 = float(np.prod(np.maximum(high - low, 1e-3)[:2])) * unit_m**2
    wanted_m = (_POINTS_PER_CELL * area_m2 / max(1, sum(head[3] for head in heads))) ** 0.5
    cell_m = next((cell for cell in _CELLS_M if cell >= wanted_m), _CELLS_M[-1])
    cell = cell_m / unit_m
    west, north = float(np.floor(low[0] / cell) * cell), float(np.ceil(high[1] / cell) * cell)
    shape = int((north - low[1]) / cell) + 1, int((high[0] - west) / cell) + 1
    if shape[0] * shape[1] > _MAX_CELLS_HELD:
        raise CityModelError(
            f"{name} spreads over {shape[0]:,} x {shape[1]:,} cells, more than {_MAX_CELLS_HELD:,}.",
            "Take fewer tiles, or leave out points far off.",
        )
    bands = _rasters(paths, shape, west, north, cell, height_unit_m(own))
    grid = SurfaceGrid(
        name, own, west, north, (cell, cell), unit_m, shape,
        read=_window_of(bands[0]), read_ground=_window_of(bands[1]), read_plants=_window_of(bands[2]),
    )  # fmt: skip
    require_size(grid)
    return grid


def _window_of(band: Floats) -> Callable[[Span, Span], Floats]:
    return lambda rows, columns: band[slice(*rows), slice(*columns)]


def _head(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], str | None, int]:
    """Returns lowest and highest coordinates, the reference system and how many points a file has."""
    for reader in _opened(path):
        header = reader.header
        system = header.parse_crs()
        if header.point_count == 0:
            raise CityModelError(f"{path} has no points.", "Is it the right tile?")
        low, high = np.array(header.mins), np.array(header.maxs)
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (high >= low).all()):
            raise CityModelError(f"{path} has a header without a place.", "Repair or download it again.")
        return low, high, None if system is None else epsg_label(system.to_wkt()), int(header.point_count)
    raise AssertionError("a file is opened or refused")


def _opened(path: Path) -> Iterator[Any]:
    """Yields the reader of a file."""
    try:
        import laspy
    except ImportError:
        raise CityModelError(
            f"Reading {path} needs laspy.", "Install it: pip install 'lodbench[laser]'."
        ) from None
    try:
        with laspy.open(path) as reader:
            yield reader
    except CityModelError:
        raise
    except Exception as error:  # laspy, lazrs and pyproj each have kinds of their own
        raise CityModelError(
            f"{path} cannot be read as laser points: {str(error).rstrip('.')}.", "Download the file again."
        ) from None


def _rasters(
    paths: Sequence[Path], shape: tuple[int, int], west: float, north: float, cell: float, unit_m: float
) -> tuple[Floats, Floats, Floats]:
    """Returns the highest of all points, the lowest of the ground's, the highest of the plants'; metres."""
    size = shape[0] * shape[1]
    surface, plants = (np.full(size, -np.inf, np.float32) for _ in range(2))
    ground = np.full(size, np.inf, np.float32)
    for path in paths:
        for reader in _opened(path):
            for points in reader.chunk_iterator(_CHUNK):
                kinds = np.asarray(points.classification)
                column = ((np.asarray(points.x) - west) / cell).astype(np.int64)
                row = ((north - np.asarray(points.y)) / cell).astype(np.int64)
                is_kept = ~np.isin(kinds, _NOISE) & (row >= 0) & (row < shape[0])
                is_kept &= (column >= 0) & (column < shape[1]) & ~np.asarray(points.withheld, np.bool_)
                place = (row * shape[1] + column)[is_kept]
                heights, kinds = (np.asarray(points.z) * unit_m).astype(np.float32)[is_kept], kinds[is_kept]
                np.maximum.at(surface, place, heights)
                is_ground, is_plant = np.isin(kinds, _GROUND), np.isin(kinds, _PLANTS)
                np.minimum.at(ground, place[is_ground], heights[is_ground])
                np.maximum.at(plants, place[is_plant], heights[is_plant])
    first, second, third = (
        np.where(np.isfinite(band), band, np.float32(np.nan)).reshape(shape)
        for band in (surface, ground, plants)
    )
    return first, second, third


_LASER_SUFFIXES = (".laz", ".las")
# Tiles may be off the common raster by so much of a cell, which is rounding.
_OFF_CELLS = 0.02


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
    paths = (file for file in sorted(path.rglob("*")) if file.suffix.lower() in SURFACE_SUFFIXES)
    files = [file for file in paths if file.is_file()]
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
    kinds = {file.suffix.lower() in _LASER_SUFFIXES for file in files}
    if len(kinds) > 1:
        raise CityModelError(f"{path} holds rasters and laser points.", "Put them into folders of their own.")
    if kinds.pop():
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
        own = crs if crs is not None or raster.crs is None else epsg_label(raster.crs.to_wkt())
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


def _plane(crs: str | None) -> object:
    known = None if crs is None else resolve_crs(crs)
    return crs if known is None else known.horizontal


def _read_tiles(tiles: Sequence[_Tile], starts: NDArray[np.int64], rows: Span, columns: Span) -> Floats:
    """Returns heights of a window; where tiles overlap, those of the first that has any."""
    heights = np.full((rows[1] - rows[0], columns[1] - columns[0]), np.nan, np.float32)
    for tile, (top, left) in zip(tiles, starts.tolist(), strict=True):
        own_rows = max(rows[0] - top, 0), min(rows[1] - top, tile.shape[0])
        own_columns = max(columns[0] - left, 0), min(columns[1] - left, tile.shape[1])
        if own_rows[0] >= own_rows[1] or own_columns[0] >= own_columns[1]:
            continue
        tile_heights = _read_tile(tile, own_rows, own_columns)
        part = heights[
            own_rows[0] + top - rows[0] : own_rows[1] + top - rows[0],
            own_columns[0] + left - columns[0] : own_columns[1] + left - columns[0],
        ]
        np.copyto(part, tile_heights, where=np.isnan(part))
    return heights


def _read_tile(tile: _Tile, rows: Span, columns: Span) -> NDArray[np.float64]:
    if tile.path.suffix.lower() == ".asc":
        heights_m = _ascii(tile.path).heights[slice(*rows), slice(*columns)] * height_unit_m(tile.crs)
    else:
        with opened_raster(tile.path, raster_driver(tile.path)) as raster:
            heights_m = read_band_m(raster, tile.crs, rows, columns)
    is_land = (heights_m > LOWEST_M) & (heights_m < HIGHEST_M)
    return np.where(is_land, heights_m, np.nan)
