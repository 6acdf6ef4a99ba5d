"""Surface models from files: GeoTIFF, ASCII grids, laser points, folders of tiles of one of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.crs import resolve_crs
from lodbench.citymodel.model import HIGHEST_M, LOWEST_M
from lodbench.citymodel.options import SURFACE_SUFFIXES
from lodbench.citymodel.surface.grid import (
    Floats,
    Span,
    SurfaceGrid,
    Terrain,
    empty_grid,
    epsg_label,
    height_unit_m,
    plane_unit_m,
    read_ascii,
    read_band_m,
    require_size,
)
from lodbench.citymodel.vector.gdal import opened_raster, raster_driver
from lodbench.errors import CityModelError

# ASPRS classes: ground; low, medium and high vegetation; low and high noise.
_GROUND, _PLANTS, _NOISE = (2,), (3, 4, 5), (7, 18)
_CHUNK = 2_000_000
# Widths of cells, metres: the narrowest that most cells of have a point.
_CELLS_M = (0.25, 0.5, 1.0, 2.0)
_POINTS_PER_CELL = 2.0
# Three rasters are held, so fewer cells than of a file that is read by windows.
_MAX_CELLS = 1 << 27


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
    if shape[0] * shape[1] > _MAX_CELLS:
        raise CityModelError(
            f"{name} spreads over {shape[0]:,} x {shape[1]:,} cells, more than {_MAX_CELLS:,}.",
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
    found = (file for file in sorted(path.rglob("*")) if file.suffix.lower() in SURFACE_SUFFIXES)
    files = [file for file in found if file.is_file()]
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
