"""The ground below footprints and surface models: a terrain model's, of laser points, or estimated.

Estimated as by the simple morphological filter (Pingel, Clarke, McBride, ISPRS Journal 77, 2013): openings of
growing width take away what is narrower and steeper than ground is; the gaps are filled from their rims.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import SURFACE_COARSE, SURFACE_GROUND_ESTIMATED, SURFACE_NO_ROOF, SURFACE_OFFSET
from lodbench.citymodel.model import HIGHEST_M, LOWEST_M
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.surface.grid import (
    BLOCK,
    MAX_CELLS,
    Floats,
    Span,
    SurfaceGrid,
    Terrain,
    empty_grid,
    height_step_m,
    height_unit_m,
    open_surface,
    read_ascii,
    read_band_m,
    tell_gaps,
    tell_steps,
)
from lodbench.citymodel.vector.gdal import opened_raster, raster_driver
from lodbench.errors import CityModelError
from lodbench.findings import Findings

# Width of the cells ground is known in, metres: it changes slowly, and houses are wider.
_GROUND_CELL_M = 2.0
# Openings reach this far to each side, metres: halls of twice the width are still no ground.
_WIDEST_M = 60.0
# Slope that ground has at most, and what a first step may rise besides, metres.
_SLOPE, _FIRST_M = 0.2, 0.3
# A terrain model further off the surface's lowest cells than this has other zero heights, metres.
_OFFSET_M = 1.0


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


def _raster_heights_m(path: Path, points: NDArray[np.float64], crs: str) -> NDArray[np.float64]:
    """Returns (N,) heights of a raster in metres; only the part of it under the points is read."""
    instead = "Or convert the raster to an ASCII grid (.asc)."
    with opened_raster(path, raster_driver(path), instead) as raster:
        grid = empty_grid(raster.transform, path)
        own_crs = crs if raster.crs is None else raster.crs.to_wkt()
        if raster.crs is not None:
            points = _projected(points, crs, own_crs)
        rows, columns = _window(grid, points, raster.shape)
        if (rows[1] - rows[0]) * (columns[1] - columns[0]) > MAX_CELLS:
            raise CityModelError(f"{path} has too many cells under the city.", "Warp it to larger cells.")
        heights_m = read_band_m(raster, own_crs, rows, columns)
    part = replace(
        grid,
        heights=heights_m,
        west=grid.west + columns[0] * grid.cell_x,
        north=grid.north - rows[0] * grid.cell_y,
    )
    return part.at(points)


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


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Heights of the ground in coarse cells."""

    heights_m: Floats  # (rows, columns) float32, without gaps
    step: int  # cells of the surface per coarse cell
    source: str  # where it comes from, in words

    def window(self, rows: Span, columns: Span) -> Floats:
        """Returns the heights below a window of the surface's cells, interpolated linearly; metres."""
        weights = [
            _neighbours(np.arange(*span, dtype=np.float64) + 0.5, self.step, side)
            for span, side in zip((rows, columns), self.heights_m.shape, strict=True)
        ]
        (row, row_next, down), (column, column_next, right) = weights
        at_rows = self.heights_m[row] * (1 - down)[:, None] + self.heights_m[row_next] * down[:, None]
        return np.asarray(at_rows[:, column] * (1 - right) + at_rows[:, column_next] * right, np.float32)


def _neighbours(
    places: NDArray[np.float64], step: int, side: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Returns the coarse cells whose middles lie before and after places, and the share of the latter."""
    exact = np.clip(places / step - 0.5, 0, side - 1)
    before = np.minimum(exact.astype(np.int64), side - 1)
    return before, np.minimum(before + 1, side - 1), (exact - before).astype(np.float32)


def find_ground(grid: SurfaceGrid, options: ReadOptions, findings: Findings) -> Ground:
    """Returns the ground below a surface model, read through once.

    Args:
        grid: The surface model.
        options: ``terrain`` names a terrain model, which goes before what the points' classes say.
        findings: Receives gaps, steps, an estimate instead of a terrain model, and other zero heights of one.

    Raises:
        CityModelError: No cell has a height, or the terrain model cannot be read or lies elsewhere.
    """
    step = max(1, round(_GROUND_CELL_M / grid.cell_m))
    lowest, missing, whole_m = _lowest(grid, step)
    tell_gaps(grid, missing, findings)
    tell_steps(grid, findings)
    if whole_m:
        findings.add(SURFACE_COARSE, "", f"steps of {whole_m:g} m")
    if options.terrain is not None:
        given = _of_terrain(grid, step, lowest.shape, options)
        _tell_offset(lowest - given, options, findings)
        return Ground(fill_gaps(given), step, "terrain model")
    if grid.read_ground is not None:
        ground = _coarse(grid, grid.read_ground, step)
        if np.isfinite(ground).any():
            return Ground(fill_gaps(ground), step, "laser points of class 2")
    findings.add(SURFACE_GROUND_ESTIMATED, "", f"openings of up to {2 * _WIDEST_M:g} m")
    return Ground(estimate_ground(lowest, step * grid.cell_m), step, "estimated from the surface model")


def _lowest(grid: SurfaceGrid, step: int) -> tuple[Floats, int, float]:
    """Returns the second lowest height in each coarse cell, how many cells have none, their step."""
    lowest = np.full([math.ceil(side / step) for side in grid.shape], np.nan, np.float32)
    missing, steps = 0, []
    side = BLOCK - BLOCK % step
    for rows, columns in grid.blocks(side):
        heights = grid.read(rows, columns)
        missing += int(np.isnan(heights).sum())
        if np.isfinite(heights).any():
            steps.append(height_step_m(heights))
        place = tuple(slice(span[0] // step, math.ceil(span[1] / step)) for span in (rows, columns))
        lowest[place] = _reduced(heights, step)
    return lowest, missing, min(steps, default=0.0)


def _coarse(grid: SurfaceGrid, read: object, step: int) -> Floats:
    """Returns the lowest of another band of a grid in each coarse cell."""
    lowest = np.full([math.ceil(side / step) for side in grid.shape], np.nan, np.float32)
    for rows, columns in grid.blocks(BLOCK - BLOCK % step):
        place = tuple(slice(span[0] // step, math.ceil(span[1] / step)) for span in (rows, columns))
        lowest[place] = _reduced(read(rows, columns), step)  # type: ignore[operator]
    return lowest


def _reduced(heights: Floats, step: int) -> Floats:
    """Returns the second lowest of step by step cells, the lowest where there is one; NaN for none."""
    if step == 1:
        return heights
    pad = [(0, -side % step) for side in heights.shape]
    padded = np.pad(heights, pad, constant_values=np.nan)
    rows, columns = padded.shape[0] // step, padded.shape[1] // step
    cells = padded.reshape(rows, step, columns, step).swapaxes(1, 2).reshape(rows, columns, step * step)
    low = np.partition(np.where(np.isnan(cells), np.inf, cells), 1, axis=2)[..., :2]
    lowest = np.where(np.isfinite(low[..., 1]), low[..., 1], low[..., 0])
    return np.where(np.isfinite(lowest), lowest, np.nan).astype(np.float32)


def _of_terrain(grid: SurfaceGrid, step: int, shape: tuple[int, ...], options: ReadOptions) -> Floats:
    """Returns the terrain model at the middles of the coarse cells, metres; NaN where it has no height."""
    terrain = np.empty(shape, np.float32)
    columns = (np.arange(shape[1]) + 0.5) * step
    for first in range(0, shape[0], 256):
        rows = (np.arange(first, min(first + 256, shape[0])) + 0.5) * step
        points = grid.places(np.tile(columns, len(rows)), np.repeat(rows, len(columns)))
        heights = ground_under(points, grid.crs or "", options) * grid.height_unit_m
        terrain[first : first + 256] = heights.reshape(len(rows), -1)
    if not np.isfinite(terrain).any():
        raise CityModelError(
            f"The terrain model {options.terrain} has no height under {grid.name}.",
            "Is it the same tile, and its reference system right?",
        )
    return terrain


def _tell_offset(above: Floats, options: ReadOptions, findings: Findings) -> None:
    """Adds a finding where the lowest fifth of the surface does not lie on the terrain model."""
    known = above[np.isfinite(above)]
    if not len(known):
        return
    off = float(np.percentile(known, 20))
    if abs(off) > _OFFSET_M:
        findings.add(SURFACE_OFFSET, "", f"the surface lies {off:+.1f} m from it")


def estimate_ground(lowest: Floats, cell_m: float) -> Floats:
    """Returns the ground of a surface model, without gaps.

    Args:
        lowest: (rows, columns) low heights of its cells, metres, NaN where there are none.
        cell_m: Their width.
    """
    from scipy.ndimage import grey_opening

    surface = fill_gaps(lowest)
    is_object = np.isnan(lowest)
    before, radius, last = surface, 1, 0
    widest = max(1, round(_WIDEST_M / cell_m))
    while last < widest:
        radius = min(radius, widest)
        opened = grey_opening(before, size=(2 * radius + 1, 2 * radius + 1))
        is_object |= before - opened > _SLOPE * (radius - last) * cell_m + _FIRST_M
        before, last, radius = opened, radius, max(radius + 1, round(1.3 * radius))
    if is_object.all():
        return before
    return fill_gaps(np.where(is_object, np.nan, surface).astype(np.float32))


def fill_gaps(heights: Floats) -> Floats:
    """Returns heights with gaps filled by ever coarser averages of what is around them."""
    gaps = np.isnan(heights)
    if not gaps.any() or gaps.all():
        return np.nan_to_num(heights) if gaps.all() else heights
    padded = np.pad(heights, [(0, side % 2) for side in heights.shape], constant_values=np.nan)
    rows, columns = padded.shape[0] // 2, padded.shape[1] // 2
    cells = padded.reshape(rows, 2, columns, 2).swapaxes(1, 2).reshape(rows, columns, 4)
    count = np.isfinite(cells).sum(axis=2)
    means = np.where(count > 0, np.nansum(cells, axis=2) / np.maximum(count, 1), np.nan).astype(np.float32)
    coarse = Ground(fill_gaps(means), 2, "")
    filled = coarse.window((0, heights.shape[0]), (0, heights.shape[1]))
    return np.where(gaps, filled, heights).astype(np.float32, copy=False)


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
    """What a surface model says of N footprints, metres in its own heights; NaN where it says nothing."""

    # (N,) heights that 10, 50 and 90 % of a roof's cells stay below
    eaves_m: Array
    middle_m: Array
    ridge_m: Array
    ground_m: Array  # (N,) the lowest ground below its cells
    cells: NDArray[np.int64]  # (N,) how many cells of it have a height


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredFootprints:
    """What a surface model says of the footprints of a file."""

    height_m: Array  # (N,) of the middle of the roof above the ground, NaN where the model shows no roof
    ground_m: Array  # (N,) the lowest ground below, in the model's height system; NaN outside of it
    roofs: RoofHeights  # all that is known of them
    ground_source: str  # where the ground comes from, in words

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
    quantiles = (_quantile(heights[is_there][order], starts, share) for share in (EAVES, MIDDLE, RIDGE))
    low = np.full(count, np.inf)
    np.minimum.at(low, owners, grounds)
    eaves, middle, ridge = (np.where(is_known, each, np.nan) for each in quantiles)
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
    labels: NDArray[np.int32] = rasterize(
        ((shape, n) for n, shape in enumerate(shapes)),
        out_shape=(rows[1] - rows[0], columns[1] - columns[0]),
        transform=from_origin(west, north, *grid.cell),
        fill=-1,
        dtype="int32",
    )
    return labels
