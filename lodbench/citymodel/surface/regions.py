"""What rises above the ground of a surface model: connected regions, without vegetation, in plane pieces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.surface.grid import BLOCK, Floats, SurfaceGrid
from lodbench.citymodel.surface.ground import Ground
from lodbench.kernels import grow_planes
from lodbench.kernels.arguments import UNLABELLED

# What rises less over the ground is a car or a hedge, metres; smaller regions are none, square metres.
LEAST_RISE_M, LEAST_AREA_M2 = 2.0, 10.0
# Cells lie within this of the plane they are drawn by, metres.
TOLERANCE_M = 0.25
# Pieces are at least so large, square metres; larger ones are roofs, and smaller ones that are as smooth.
_LEAST_PIECE_M2, _ROOF_M2, _SMOOTH_M2, _SMOOTH_M = 3.0, 15.0, 8.0, 0.09
# Steeper planes are walls between two cells: rise per metre.
_STEEPEST = 3.0
# Between pieces, what is no plane and wider than twice this is vegetation, metres.
_PLANT_RADIUS_M = 1.25
# Where a laser's highest point of vegetation is this near below the surface, the cell is vegetation, metres.
_BELOW_CROWN_M = 0.5
# Windows reach this much beyond a block, metres: regions within that are never cut.
_HALO_M = 128.0
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.bool_)
# Cells that belong to no piece ever.
_OUTSIDE = -1
_SQUARE = np.ones((2, 2), np.bool_)


class Pieces(NamedTuple):
    """Plane pieces of a window of cells."""

    # (rows, columns) int32: the piece of each cell from 1 on, ``UNLABELLED`` or less
    labels: NDArray[np.int32]
    # (N, 3) height of piece n + 1 at row r and column c (middles at + 0.5): [0] r + [1] c + [2]
    planes: NDArray[np.float64]
    counts: NDArray[np.int64]  # (N,) cells
    rms_m: NDArray[np.float64]  # (N,) root mean square distance of its cells from the plane


@dataclass(slots=True)
class RegionCounts:
    """What was met on the way."""

    plants: int = 0  # regions, or parts of one, that were taken as vegetation
    plants_m2: float = 0.0  # their area
    cells: int = 0  # cells drawn
    # Of them, cells further than the tolerance from the plane they are drawn by: chimneys and edges
    far: int = 0
    cut: int = 0  # regions that were cut where blocks end


class Window(NamedTuple):
    """The pieces of a window that are drawn with its block."""

    corner: tuple[int, int]  # row and column of its first cell
    pieces: Pieces  # labels of cells, ``UNLABELLED`` or less where nothing is drawn
    low_m: NDArray[np.float64]  # (N,) the lowest ground below each piece's region
    # (N, 2) row and column, of the whole grid, of the first cell of each piece's region
    first: NDArray[np.int64]
    ends_m: NDArray[np.float64]  # (N, 2) lowest and highest cell of each piece


def windows_of(
    grid: SurfaceGrid, ground: Ground, counts: RegionCounts, is_green: Any = None
) -> Iterator[Window]:
    """Yields what rises above the ground, block by block: in memory is a block with its halo.

    Regions of less than the halo's width are drawn whole, with the block that has their first cell; longer
    ones are cut where blocks end. So what is drawn does not depend on where they do, but for these cuts.

    Args:
        grid: The surface model.
        ground: Below it.
        counts: Receives what was met.
        is_green: Tells which cells of two spans are green; None where nobody knows.
    """
    halo = max(2, round(_HALO_M / grid.cell_m))
    for rows, columns in grid.blocks(BLOCK):
        spans = [
            (max(span[0] - halo, 0), min(span[1] + halo, side))
            for span, side in zip((rows, columns), grid.shape, strict=True)
        ]
        core = tuple(slice(a[0] - b[0], a[1] - b[0]) for a, b in zip((rows, columns), spans, strict=True))
        heights = grid.read(*spans)
        if not np.isfinite(heights[core]).any():
            continue
        heights = _without_pinholes(heights)
        below = ground.window(*spans)
        rise = heights - below
        if grid.read_plants is not None:
            plants = grid.read_plants(*spans)
            rise[plants >= heights - _BELOW_CROWN_M] = 0.0
        regions = _regions(rise, grid.cell_m, core, halo, counts)
        if not regions.any():
            continue
        green = None if is_green is None else is_green(*spans)
        window = _drawn(heights, below, regions, green, grid.cell_m, counts)
        if window is not None:
            corner = spans[0][0], spans[1][0]
            yield window._replace(corner=corner, first=window.first + corner)


def _without_pinholes(heights: Floats) -> Floats:
    """Returns heights with gaps of up to two cells filled by the highest neighbour."""
    from scipy.ndimage import binary_erosion, maximum_filter

    gaps = np.isnan(heights)
    if not gaps.any():
        return heights
    wide = binary_erosion(gaps, np.ones((3, 3), np.bool_), border_value=1)
    near = maximum_filter(np.where(gaps, -np.inf, heights), size=3)
    is_filled = gaps & ~wide & np.isfinite(near)
    return np.where(is_filled, near, heights)


def _regions(
    rise: Floats, cell_m: float, core: tuple[slice, ...], halo: int, counts: RegionCounts
) -> NDArray[np.int32]:
    """Returns numbers of the regions that are drawn with a block, 0 elsewhere."""
    from scipy.ndimage import binary_opening, find_objects, label

    is_raised = np.nan_to_num(rise, nan=0.0) > LEAST_RISE_M
    if cell_m < 0.8:  # poles, wires and the cells in which walls are smeared out
        is_raised = binary_opening(is_raised, _SQUARE)
    labels, count = label(is_raised)
    in_core = np.zeros(rise.shape, np.bool_)
    in_core[core] = True
    sizes = np.bincount(labels.reshape(-1), minlength=count + 1)
    is_kept = sizes * cell_m**2 >= LEAST_AREA_M2
    is_kept[0] = False
    for number, place in enumerate(find_objects(labels), start=1):
        if place is None or not is_kept[number]:
            continue
        if max(span.stop - span.start for span in place) > halo:
            piece = labels[place]
            is_cut = (piece == number) & ~in_core[place]
            if is_cut.any():
                counts.cut += bool(((piece == number) & ~is_cut).any())
                piece[is_cut] = 0
            continue
        row = place[0].start
        column = place[1].start + int(np.argmax(labels[row, place[1]] == number))
        is_kept[number] = in_core[row, column]
    return np.where(is_kept[labels], labels, 0).astype(np.int32)


def _drawn(
    heights: Floats,
    below: Floats,
    regions: NDArray[np.int32],
    green: NDArray[np.bool_] | None,
    cell_m: float,
    counts: RegionCounts,
) -> Window | None:
    """Returns the pieces of a window's regions, vegetation left out; None where nothing is left."""
    from scipy.ndimage import distance_transform_edt, label

    is_region = regions > 0
    least = max(4, round(_LEAST_PIECE_M2 / cell_m**2))
    filled = np.where(is_region, heights, 0.0).astype(np.float32)
    pieces = grow_pieces(filled, is_region, TOLERANCE_M, least, _STEEPEST * cell_m)
    is_roof = _roofs(pieces, green, cell_m)
    is_plant = _plants(pieces, is_roof, is_region, green, cell_m)
    is_left = is_region & ~is_plant
    parts, count = label(is_left)
    sizes = np.bincount(parts.reshape(-1), minlength=count + 1) * cell_m**2
    has_roof = np.zeros(count + 1, np.bool_)
    has_roof[parts[is_roof[np.maximum(pieces.labels, 0)] & is_left]] = True
    is_small = (sizes < LEAST_AREA_M2) | ~has_roof
    is_small[0] = False
    is_left &= ~is_small[parts]
    _, plants = label(is_region & ~is_left)
    counts.plants += plants
    counts.plants_m2 += float((is_region & ~is_left).sum()) * cell_m**2
    if not is_left.any():
        return None
    # What is no plane is drawn by the nearest piece.
    known = (pieces.labels > UNLABELLED) & is_left
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    labels = np.where(is_left, pieces.labels[tuple(nearest)], 0).astype(np.int32)
    return _window(heights, below, labels, np.where(is_left, parts, 0), pieces, counts)


def grow_pieces(
    heights: Floats, is_asked: NDArray[np.bool_], tolerance_m: float, least_cells: int, steepest_m: float
) -> Pieces:
    """Returns plane pieces of some cells, grown from the smoothest places on.

    Every cell of a piece lies within the tolerance of its plane.

    Args:
        heights: (rows, columns) metres, finite where asked.
        is_asked: Which cells may be part of a piece.
        tolerance_m: Largest vertical distance of a cell from its plane.
        least_cells: Smaller pieces are none.
        steepest_m: Rise of a plane from a cell to the next at most.
    """
    bends = np.full(heights.shape, np.inf, np.float32)
    middle = heights[1:-1, 1:-1]
    bends[1:-1, 1:-1] = np.abs(heights[:-2, 1:-1] + heights[2:, 1:-1] - 2 * middle)
    bends[1:-1, 1:-1] += np.abs(heights[1:-1, :-2] + heights[1:-1, 2:] - 2 * middle)
    labels = np.where(is_asked, UNLABELLED, _OUTSIDE).astype(np.int32)
    seeds = np.flatnonzero(is_asked & np.isfinite(bends))
    seeds = seeds[np.argsort(bends.reshape(-1)[seeds], kind="stable")]
    most = int(is_asked.sum()) // max(least_cells, 1) + 1
    planes, counts, rms = np.zeros((most, 3)), np.zeros(most, np.int64), np.zeros(most)
    count = grow_planes(heights, labels, seeds, tolerance_m, least_cells, steepest_m, planes, counts, rms)
    return Pieces(labels, planes[:count], counts[:count], rms[:count])


def _roofs(pieces: Pieces, green: NDArray[np.bool_] | None, cell_m: float) -> NDArray[np.bool_]:
    """Returns (N + 1,) which labels are roofs: pieces that are large, or less large and smooth.

    By heights alone a hedge cut flat is a roof, and a dome none. Where colour tells, what is not green is a
    roof, and a piece half of which is green only if it is large and smooth.
    """
    area_m2 = pieces.counts * cell_m**2
    is_smooth = pieces.rms_m <= _SMOOTH_M
    is_roof = np.concatenate([[False], (area_m2 >= _ROOF_M2) | ((area_m2 >= _SMOOTH_M2) & is_smooth)])
    if green is not None:
        own = np.maximum(pieces.labels, 0).reshape(-1)
        cells = np.maximum(np.bincount(own, minlength=len(is_roof)), 1)
        share = np.bincount(own, green.reshape(-1), len(is_roof)) / cells
        is_roof[1:] = (share[1:] < 0.5) | ((area_m2 >= _ROOF_M2) & is_smooth)
    return is_roof


def _plants(
    pieces: Pieces,
    is_roof: NDArray[np.bool_],
    is_region: NDArray[np.bool_],
    green: NDArray[np.bool_] | None,
    cell_m: float,
) -> NDArray[np.bool_]:
    """Returns which cells are vegetation: what is wide and no roof, and where colour tells, green."""
    from scipy.ndimage import binary_dilation, binary_opening

    is_open = is_region & ~is_roof[np.maximum(pieces.labels, 0)]
    if green is not None:
        is_open &= green
    radius = max(1, round(_PLANT_RADIUS_M / cell_m))
    offsets = np.arange(-radius, radius + 1)
    disk = offsets[:, None] ** 2 + offsets**2 <= radius**2
    core = binary_opening(is_open, disk)
    # The rim of a crown is narrow between core and ground; that of a roof is no part of a core.
    grown = binary_dilation(core, _CROSS, iterations=max(1, round(1.0 / cell_m)), mask=is_open)
    return np.asarray(grown, np.bool_)


def _window(
    heights: Floats,
    below: Floats,
    labels: NDArray[np.int32],
    parts: NDArray[np.int64],
    pieces: Pieces,
    counts: RegionCounts,
) -> Window:
    rows, columns = np.nonzero(labels)
    own = labels[rows, columns] - 1
    z = heights[rows, columns].astype(np.float64)
    plane = pieces.planes[own]
    off = np.abs(plane[:, 0] * (rows + 0.5) + plane[:, 1] * (columns + 0.5) + plane[:, 2] - z)
    counts.cells += len(rows)
    counts.far += int((off > TOLERANCE_M).sum())
    count = len(pieces.planes)
    inside = labels[rows, columns] == pieces.labels[rows, columns]
    ends = np.stack([np.full(count, np.inf), np.full(count, -np.inf)], axis=1)
    np.minimum.at(ends[:, 0], own[inside], z[inside])
    np.maximum.at(ends[:, 1], own[inside], z[inside])
    part = parts[rows, columns]
    low = np.full(int(parts.max()) + 1, np.inf)
    np.minimum.at(low, part, below[rows, columns].astype(np.float64))
    first = np.full(len(low), len(rows))
    np.minimum.at(first, part, np.arange(len(rows)))
    part_of = np.zeros(count, np.int64)
    part_of[own] = part
    start = np.minimum(first[part_of], len(rows) - 1)
    places = np.stack([rows[start], columns[start]], axis=1)
    return Window((0, 0), pieces._replace(labels=labels), low[part_of], places, ends)
