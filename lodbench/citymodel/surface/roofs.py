"""Heights of roofs over footprints, from the cells of a surface model inside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import SURFACE_NO_ROOF
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.surface.files import open_surface
from lodbench.citymodel.surface.grid import BLOCK, Span, SurfaceGrid
from lodbench.citymodel.surface.ground import Ground, find_ground
from lodbench.findings import Findings

Array = NDArray[np.float64]

# Cells beside the eaves show wall and ground: so much of a footprint's rim is left out, metres, and a cell.
_RIM_M = 0.5
# Of fewer cells nothing is known of a roof; nor of one half of whose cells have no height.
_LEAST_CELLS, _LEAST_SHARE = 4, 0.5
# Shares of the cells below eaves, the middle and the ridge: a chimney or an overhanging tree is neither.
EAVES, MIDDLE, RIDGE = 0.1, 0.5, 0.9
# What rises less over the ground is no building that stands there, metres.
_LEAST_RISE_M = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class RoofHeights:
    """What a surface model says of N footprints, metres in its own height system; NaN where it says nothing.

    Attributes:
        eaves_m, middle_m, ridge_m: (N,) heights that 10, 50 and 90 % of a roof's cells stay below.
        ground_m: (N,) the lowest ground below its cells.
        cells: (N,) how many cells of it have a height.
    """

    eaves_m: Array
    middle_m: Array
    ridge_m: Array
    ground_m: Array
    cells: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredFootprints:
    """What a surface model says of the footprints of a file.

    Attributes:
        height_m: (N,) of the middle of the roof above the ground, NaN where the model shows no roof.
        ground_m: (N,) the lowest ground below, in the model's height system; NaN outside of it.
        roofs: All that is known of them.
        ground_source: Where the ground comes from, in words.
    """

    height_m: Array
    ground_m: Array
    roofs: RoofHeights
    ground_source: str

    def attributes(self, n: int) -> dict[str, Any]:
        """Returns what is known of a footprint's roof, by names for a city file: metres above the ground."""
        if not np.isfinite(self.height_m[n]):
            return {}
        roofs, ground = self.roofs, self.roofs.ground_m[n]
        return {
            "eaves_height_m": round(float(roofs.eaves_m[n] - ground), 2),
            "ridge_height_m": round(float(roofs.ridge_m[n] - ground), 2),
            "roof_cells": int(roofs.cells[n]),
        }


def measure_footprints(
    geometries: Sequence[bytes | None], ids: Sequence[str], crs: str, options: ReadOptions, findings: Findings
) -> MeasuredFootprints:
    """Returns the heights of footprints by the surface model of ``options.surface``.

    Args:
        geometries: N as well-known binary, None for those without.
        ids: Of the footprints, for the findings.
        crs: Their reference system; they are brought to that of the surface model.
        options: ``surface`` and ``terrain``.
        findings: Receives what was met, and the footprints over which no roof is shown.

    Raises:
        CityModelError: The surface model or the terrain model cannot be read.
    """
    import shapely

    grid = open_surface(Path(str(options.surface)))
    ground = find_ground(grid, options, findings)
    shapes = shapely.from_wkb(np.array(geometries, dtype=object), on_invalid="ignore")
    shapes = np.where(shapely.is_missing(shapes), shapely.Polygon(), shapes)
    if grid.crs is not None:
        from pyproj import Transformer

        transformer = Transformer.from_crs(crs, grid.crs, always_xy=True)
        shapes = shapely.transform(
            shapely.force_2d(shapes),
            lambda points: np.stack(transformer.transform(points[:, 0], points[:, 1]), axis=1),
        )
    roofs = measure_roofs(grid, ground, shapely.make_valid(shapes))
    height_m = roofs.middle_m - roofs.ground_m
    is_roof = height_m > _LEAST_RISE_M
    for n in np.flatnonzero(~is_roof).tolist():
        known = np.isfinite(height_m[n])
        what = f"it rises {height_m[n]:.1f} m" if known else f"{roofs.cells[n]} cells with a height"
        findings.add(SURFACE_NO_ROOF, ids[n], what)
    return MeasuredFootprints(np.where(is_roof, height_m, np.nan), roofs.ground_m, roofs, ground.source)


def measure_roofs(grid: SurfaceGrid, ground: Ground, footprints: NDArray[Any]) -> RoofHeights:
    """Returns the heights of roofs over footprints.

    A footprint's rim is left out where enough is left of it. Of a roof half of whose cells have no height
    nothing is told.

    Args:
        grid: The surface model, read by windows.
        ground: Below it.
        footprints: (N,) shapely polygons in its reference system.
    """
    import shapely

    rim = max(_RIM_M, grid.cell_m) / grid.unit_m
    cell_area = grid.cell[0] * grid.cell[1]
    inner = shapely.buffer(footprints, -rim, join_style="mitre")
    is_kept = shapely.area(inner) >= _LEAST_CELLS * cell_area
    inner = np.where(is_kept, inner, footprints)
    owners, heights, grounds = _cells_of(grid, ground, inner)
    count, is_there = len(footprints), np.isfinite(heights)
    cells, total = (np.bincount(each, minlength=count) for each in (owners[is_there], owners))
    is_known = (cells >= np.minimum(_LEAST_CELLS, total)) & (cells > 0) & (cells >= _LEAST_SHARE * total)
    order = np.lexsort((heights[is_there], owners[is_there]))
    starts = np.concatenate([[0], np.cumsum(cells)])
    found = (_quantile(heights[is_there][order], starts, share) for share in (EAVES, MIDDLE, RIDGE))
    low = np.full(count, np.inf)
    np.minimum.at(low, owners, grounds)
    eaves, middle, ridge = (np.where(is_known, each, np.nan) for each in found)
    return RoofHeights(eaves, middle, ridge, np.where(np.isfinite(low), low, np.nan), cells)


def _quantile(heights: Array, starts: NDArray[np.int64], share: float) -> Array:
    """Returns a quantile of each run of ascending heights, interpolated linearly; NaN of an empty one."""
    if not len(heights):
        return np.full(len(starts) - 1, np.nan)
    last = np.diff(starts) - 1
    place = np.maximum(share * last, 0.0)
    before = np.floor(place).astype(np.int64)
    at = np.minimum(starts[:-1] + before, len(heights) - 1)
    after = np.minimum(starts[:-1] + np.minimum(before + 1, np.maximum(last, 0)), len(heights) - 1)
    value = heights[at] + (place - before) * (heights[after] - heights[at])
    return np.where(last >= 0, value, np.nan)


def _cells_of(
    grid: SurfaceGrid, ground: Ground, shapes: NDArray[Any]
) -> tuple[NDArray[np.int64], Array, Array]:
    """Returns the footprint of each cell inside one, its height, NaN for none, and the ground below."""
    import shapely

    bounds = shapely.bounds(shapes)
    columns = (bounds[:, [0, 2]] - grid.west) / grid.cell[0]
    rows = (grid.north - bounds[:, [3, 1]]) / grid.cell[1]
    parts: list[tuple[NDArray[Any], ...]] = [(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))]
    for row_span, column_span in grid.blocks(BLOCK):
        is_here = (rows[:, 1] > row_span[0]) & (rows[:, 0] < row_span[1])
        is_here &= (columns[:, 1] > column_span[0]) & (columns[:, 0] < column_span[1])
        here = np.flatnonzero(is_here)
        if not len(here):
            continue
        owner = burnt(grid, shapes[here], row_span, column_span)
        is_inside = owner >= 0
        heights = grid.read(row_span, column_span)[is_inside].astype(np.float64)
        below = ground.window(row_span, column_span)[is_inside].astype(np.float64)
        parts.append((here[owner[is_inside]], heights, below))
    owners, heights, below = (np.concatenate(each) for each in zip(*parts, strict=True))
    return owners, heights, below


def burnt(grid: SurfaceGrid, shapes: NDArray[Any], rows: Span, columns: Span) -> NDArray[np.int32]:
    """Returns which of some polygons holds the middle of each cell, the last of several; -1 for none."""
    from rasterio.features import rasterize
    from rasterio.transform import from_origin

    west, north = (float(value) for value in grid.places(np.array([columns[0]]), np.array([rows[0]]))[0])
    found: NDArray[np.int32] = rasterize(
        ((shape, n) for n, shape in enumerate(shapes)),
        out_shape=(rows[1] - rows[0], columns[1] - columns[0]),
        transform=from_origin(west, north, *grid.cell),
        fill=-1,
        dtype="int32",
    )
    return found
