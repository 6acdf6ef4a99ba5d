"""Laser points (LAS, LAZ) as a surface model: the highest of each cell, and what their classes tell apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.surface.grid import Floats, Span, SurfaceGrid, epsg_label, plane_unit_m, require_size
from lodbench.citymodel.terrain import height_unit_m
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
    """Yields the reader of a file.

    Raises:
        CityModelError: laspy is not installed, or the file cannot be read.
    """
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
