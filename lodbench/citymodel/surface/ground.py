"""The ground below a surface model: from a terrain model, from laser points, or estimated from it.

Estimated as by the simple morphological filter (Pingel, Clarke, McBride, ISPRS Journal 77, 2013): openings of
growing width take away what is narrower and steeper than ground is; the gaps are filled from their rims.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import SURFACE_COARSE, SURFACE_GROUND_ESTIMATED, SURFACE_OFFSET
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.surface.grid import (
    BLOCK,
    Floats,
    Span,
    SurfaceGrid,
    height_step_m,
    tell_gaps,
    tell_steps,
)
from lodbench.citymodel.terrain import ground_under
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


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Heights of the ground in coarse cells.

    Attributes:
        heights_m: (rows, columns) float32, without gaps.
        step: Cells of the surface per coarse cell.
        source: Where it comes from, in words.
    """

    heights_m: Floats
    step: int
    source: str

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
    found = np.full([math.ceil(side / step) for side in grid.shape], np.nan, np.float32)
    for rows, columns in grid.blocks(BLOCK - BLOCK % step):
        place = tuple(slice(span[0] // step, math.ceil(span[1] / step)) for span in (rows, columns))
        found[place] = _reduced(read(rows, columns), step)  # type: ignore[operator]
    return found


def _reduced(heights: Floats, step: int) -> Floats:
    """Returns the second lowest of step by step cells, the lowest where there is one; NaN for none."""
    if step == 1:
        return heights
    pad = [(0, -side % step) for side in heights.shape]
    padded = np.pad(heights, pad, constant_values=np.nan)
    rows, columns = padded.shape[0] // step, padded.shape[1] // step
    cells = padded.reshape(rows, step, columns, step).swapaxes(1, 2).reshape(rows, columns, step * step)
    low = np.partition(np.where(np.isnan(cells), np.inf, cells), 1, axis=2)[..., :2]
    found = np.where(np.isfinite(low[..., 1]), low[..., 1], low[..., 0])
    return np.where(np.isfinite(found), found, np.nan).astype(np.float32)


def _of_terrain(grid: SurfaceGrid, step: int, shape: tuple[int, ...], options: ReadOptions) -> Floats:
    """Returns the terrain model at the middles of the coarse cells, metres; NaN where it has no height."""
    found = np.empty(shape, np.float32)
    columns = (np.arange(shape[1]) + 0.5) * step
    for first in range(0, shape[0], 256):
        rows = (np.arange(first, min(first + 256, shape[0])) + 0.5) * step
        points = grid.places(np.tile(columns, len(rows)), np.repeat(rows, len(columns)))
        heights = ground_under(points, grid.crs or "", options) * grid.height_unit_m
        found[first : first + 256] = heights.reshape(len(rows), -1)
    if not np.isfinite(found).any():
        raise CityModelError(
            f"The terrain model {options.terrain} has no height under {grid.name}.",
            "Is it the same tile, and its reference system right?",
        )
    return found


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
