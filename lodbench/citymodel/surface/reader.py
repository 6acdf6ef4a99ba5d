"""A surface model as a city: what rises above the ground, in plane pieces with walls, as level 2."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import SURFACE_NO_DATUM, SURFACE_PLANTS, SURFACE_SIMPLIFIED
from lodbench.citymodel.crs import resolve_crs
from lodbench.citymodel.model import SurfaceKind
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.raw import GrowingArray, NotACity, RawCity, city_of_columns
from lodbench.citymodel.surface.grid import Span, SurfaceGrid, open_surface
from lodbench.citymodel.surface.ground import find_ground
from lodbench.citymodel.surface.orthophoto import green_of
from lodbench.citymodel.surface.regions import LEAST_RISE_M, TOLERANCE_M, RegionCounts, Window, windows_of
from lodbench.findings import Findings

Array = NDArray[np.float64]

# Outlines follow the borders of cells within this many of their widths.
_SMOOTHING_CELLS = 1.25
# Steps between pieces of one building; higher ones part buildings, metres.
_ONE_BUILDING_M = 1.5
# Lower walls are left out, metres.
_LEAST_WALL_M = 0.02
# Planes are not followed further beyond their own cells' heights, metres.
_BEYOND_M = 0.5


class Solids(NamedTuple):
    """Polygons of a window, flat, in cells and metres."""

    points: Array  # (P, 3) column, row, height in metres
    ring_lengths: NDArray[np.int64]  # (R,) int64
    ring_counts: NDArray[np.int64]  # (N,) rings of each polygon
    building: NDArray[np.int64]  # (N,) int64
    kind: NDArray[np.uint8]  # (N,) uint8
    # (B, 2) row and column of the first cell of the piece that each building begins with
    first: NDArray[np.int64]


class _Edges(NamedTuple):
    """Edges of outlines, the piece on their left; places are (E, 2) column and row."""

    start: Array
    end: Array
    piece: NDArray[np.int64]
    other: NDArray[np.int64]


def solids_of(window: Window) -> Solids | None:
    """Returns the roofs of a window's pieces and the walls at their edges; None where outlines vanish.

    Outlines are simplified together, so that neighbours keep an edge in common. A wall stands where a piece
    is higher than its neighbour, or ends at the ground: the lowest below its region. Pieces that meet with
    steps of less than 1.5 m are one building.
    """
    outlines, piece = _outlines(window.pieces.labels)
    if not len(outlines):
        return None
    edges = _edges(outlines, piece)
    at_start, at_end = (_heights(window, edges.piece, places) for places in (edges.start, edges.end))
    has_other = edges.other >= 0
    floor = window.low_m[edges.piece]
    below = [
        np.where(has_other, _heights(window, np.maximum(edges.other, 0), places), floor)
        for places in (edges.start, edges.end)
    ]
    walls, lengths, wall_piece = _walls(edges, at_start, at_end, *below)
    steps = np.abs(0.5 * (at_start + at_end - below[0] - below[1]))
    building_of, first = _buildings(window, edges, steps, np.unique(piece))
    roofs, roof_lengths, roof_counts = _roofs(window, outlines, piece)
    kinds = np.repeat(np.array([SurfaceKind.ROOF, SurfaceKind.WALL], np.uint8), [len(piece), len(lengths)])
    return Solids(
        points=np.concatenate([roofs, walls]),
        ring_lengths=np.concatenate([roof_lengths, lengths]),
        ring_counts=np.concatenate([roof_counts, np.ones(len(lengths), np.int64)]),
        building=building_of[np.concatenate([piece, wall_piece])],
        kind=kinds,
        first=first,
    )


def _outlines(labels: NDArray[np.int32]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Returns simplified polygons (column, row), outlines counter-clockwise on the map, and their pieces.

    Borders between two pieces are simplified once (Douglas and Peucker), so that both have the same.
    """
    import shapely

    padded = np.pad(labels, 1)
    sides = []
    for axis, step in ((0, (1, 0)), (1, (0, 1))):
        # Between a cell and the one after it along an axis, cells counted without the rim.
        row, column = np.nonzero(np.diff(padded, axis=axis))
        start = np.stack([column - (axis == 0), row - (axis == 1)], axis=1)
        sides.append(np.stack([start, start + step], axis=1))
    lines = shapely.multilinestrings(shapely.linestrings(np.concatenate(sides).astype(np.float64)))
    arcs = shapely.simplify(shapely.get_parts(shapely.line_merge(lines)), _SMOOTHING_CELLS)
    faces = shapely.get_parts(shapely.polygonize(shapely.get_parts(shapely.union_all(arcs))))
    inside = shapely.get_coordinates(shapely.point_on_surface(faces))
    last = np.array(labels.shape)[::-1] - 1
    column, row = np.clip(np.floor(inside), 0, last).astype(np.int64).T
    piece = labels[row, column].astype(np.int64) - 1
    # Rows grow to the south: what is clockwise in rows and columns is counter-clockwise on the map.
    return shapely.orient_polygons(faces[piece >= 0], exterior_cw=True), piece[piece >= 0]


def _rings(outlines: NDArray[Any]) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Returns points of rings without the closing ones, offsets of rings and of polygons."""
    import shapely

    _, points, (ring_starts, polygon_starts) = shapely.to_ragged_array(outlines, include_z=False)
    is_last = np.zeros(len(points), np.bool_)
    is_last[ring_starts[1:] - 1] = True
    starts = np.asarray(ring_starts, np.int64) - np.arange(len(ring_starts))
    return points[~is_last], starts, np.asarray(polygon_starts, np.int64)


def _edges(outlines: NDArray[Any], piece: NDArray[np.int64]) -> _Edges:
    """Returns all edges of outlines and holes, with the piece on either side; -1 for none."""
    points, ring_starts, polygon_starts = _rings(outlines)
    following = np.arange(len(points)) + 1
    following[ring_starts[1:] - 1] = ring_starts[:-1]
    polygon_of_ring = np.repeat(np.arange(len(piece)), np.diff(polygon_starts))
    own = piece[np.repeat(polygon_of_ring, np.diff(ring_starts))]
    _, place = np.unique(points[:, 0] + 1j * points[:, 1], return_inverse=True)
    count = int(place.max()) + 1
    key, opposite = place * count + place[following], place[following] * count + place
    order = np.argsort(key, kind="stable")
    index = np.minimum(np.searchsorted(key[order], opposite), len(key) - 1)
    other = np.where(key[order][index] == opposite, own[order][index], -1)
    return _Edges(points, points[following], own, other)


def _heights(window: Window, piece: NDArray[np.int64], places: Array) -> Array:
    """Returns the heights of pieces' planes at places (N, 2), kept near those of their cells."""
    plane = window.pieces.planes[piece]
    z = plane[:, 0] * places[:, 1] + plane[:, 1] * places[:, 0] + plane[:, 2]
    low, high = window.ends_m[piece].T
    return np.asarray(np.clip(z, low - _BEYOND_M, high + _BEYOND_M))


def _roofs(
    window: Window, outlines: NDArray[Any], piece: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    points, ring_starts, polygon_starts = _rings(outlines)
    counts = np.diff(polygon_starts)
    own = np.repeat(np.repeat(piece, counts), np.diff(ring_starts))
    return np.column_stack([points, _heights(window, own, points)]), np.diff(ring_starts), counts


def _walls(
    edges: _Edges, at_start: Array, at_end: Array, below_start: Array, below_end: Array
) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Returns the walls where pieces are higher than what is beside them: points, ring lengths, pieces.

    Where planes cross along an edge, each piece has the triangle on its own side.
    """
    rise_start, rise_end = at_start - below_start, at_end - below_end
    is_up, is_down = np.maximum(rise_start, rise_end) > _LEAST_WALL_M, np.minimum(rise_start, rise_end) < 0
    whole = np.flatnonzero(is_up & ~is_down)
    p, q = edges.start[whole], edges.end[whole]
    quads = np.stack(
        [
            np.column_stack([p, below_start[whole]]),
            np.column_stack([q, below_end[whole]]),
            np.column_stack([q, at_end[whole]]),
            np.column_stack([p, at_start[whole]]),
        ],
        axis=1,
    )
    part = np.flatnonzero(is_up & is_down)
    share = (rise_start[part] / (rise_start[part] - rise_end[part]))[:, None]
    start = np.column_stack([edges.start, at_start])[part]
    crossing = start + share * (np.column_stack([edges.end, at_end])[part] - start)
    is_first = (rise_start[part] > 0)[:, None]
    foot = np.where(
        is_first,
        np.column_stack([edges.start, below_start])[part],
        np.column_stack([edges.end, below_end])[part],
    )
    top = np.where(is_first, start, np.column_stack([edges.end, at_end])[part])
    turned = np.stack([foot, np.where(is_first, crossing, top), np.where(is_first, top, crossing)], axis=1)
    lengths = np.repeat([4, 3], [len(whole), len(part)]).astype(np.int64)
    points = np.concatenate([quads.reshape(-1, 3), turned.reshape(-1, 3)])
    return points, lengths, edges.piece[np.concatenate([whole, part])]


def _buildings(
    window: Window, edges: _Edges, steps: Array, used: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the building of each piece, and the first cell of the piece that each begins with."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(window.pieces.planes)
    is_joint = (edges.other >= 0) & (edges.other != edges.piece)
    length = np.linalg.norm(edges.end - edges.start, axis=1)[is_joint]
    pairs = edges.piece[is_joint], edges.other[is_joint]
    total = coo_array((length, pairs), shape=(count, count)).tocsr()
    stepped = coo_array((length * steps[is_joint], pairs), shape=(count, count)).tocsr()
    joined = total.copy()
    joined.data = (stepped.data <= _ONE_BUILDING_M * total.data).astype(np.float64)
    joined.eliminate_zeros()
    _, group = connected_components(joined, directed=False)
    _, numbers = np.unique(group[used], return_inverse=True)
    building = np.full(count, -1, np.int64)
    building[used] = numbers.reshape(-1)
    rows, columns = np.nonzero(window.pieces.labels)
    own = building[window.pieces.labels[rows, columns] - 1]
    is_known = own >= 0
    first: NDArray[np.int64] = np.full(int(building.max()) + 1, len(rows))
    np.minimum.at(first, own[is_known], np.flatnonzero(is_known))
    first = np.minimum(first, len(rows) - 1)
    cells = np.stack([rows[first], columns[first]], axis=1) + np.asarray(window.corner)
    return building, cells.astype(np.int64)


def read_surface(path: Path, source: str, options: ReadOptions) -> RawCity:
    """Returns what rises above the ground of a surface model as buildings of level 2.

    A building is a connected region, less what is taken as vegetation, parted at steps of 1.5 m; its id is
    the row and column of its first cell. The surface is read block by block, twice.

    Args:
        path: GeoTIFF, ASCII grid, LAS, LAZ, or a folder of tiles.
        source: Name for messages.
        options: ``crs``, ``terrain``, ``orthophoto``.

    Raises:
        CityModelError: It cannot be read, or has no height.
        NotACity: Nothing rises above the ground.
    """
    grid = open_surface(path, options.crs)
    return surface_city(grid, source, options, green_of(grid, options))


def surface_city(
    grid: SurfaceGrid,
    source: str,
    options: ReadOptions,
    is_green: Callable[[Span, Span], NDArray[np.bool_]] | None = None,
) -> RawCity:
    """Returns what rises above the ground of a grid; see ``read_surface``.

    Args:
        grid: Heights.
        source: Name for messages.
        options: ``terrain``.
        is_green: Tells which cells of two spans are green; None where no orthophoto says so.

    Raises:
        CityModelError: The grid has no height.
        NotACity: Nothing rises above the ground.
    """
    findings, counts = Findings(), RegionCounts()
    ground = find_ground(grid, options, findings)
    columns: dict[str, GrowingArray] = {
        "points": GrowingArray(np.float64, (3,)),
        "ring_lengths": GrowingArray(np.int64),
        "ring_counts": GrowingArray(np.int64),
        "building": GrowingArray(np.int32),
        "kind": GrowingArray(np.uint8),
    }
    ids: list[str] = []
    for window in windows_of(grid, ground, counts, is_green):
        solids = solids_of(window)
        if solids is None:
            continue
        place = solids.points[:, :2] + window.corner[::-1]
        z = solids.points[:, 2:] / grid.height_unit_m
        columns["points"].extend(np.hstack([grid.places(place[:, 0], place[:, 1]), z]))
        columns["ring_lengths"].extend(solids.ring_lengths)
        columns["ring_counts"].extend(solids.ring_counts)
        columns["building"].extend(solids.building + len(ids))
        columns["kind"].extend(solids.kind)
        ids += [f"r{row}c{column}" for row, column in solids.first.tolist()]
    if not ids:
        raise NotACity(
            f"Nothing in {source} rises {LEAST_RISE_M:g} m above the ground.", "Is it a terrain model?"
        )
    _tell(grid, counts, findings)
    return city_of_columns(
        {name: column.finish() for name, column in columns.items()},
        source=source,
        format="surface model",
        srs_names=(grid.crs,),
        building_ids=tuple(ids),
        lods=("2",),
        findings=findings,
        axis_orders=("east_first",),
    )


def _tell(grid: SurfaceGrid, counts: RegionCounts, findings: Findings) -> None:
    known = None if grid.crs is None else resolve_crs(grid.crs)
    if known is not None and known.vertical_code is None and not known.has_ellipsoidal_heights:
        findings.add(SURFACE_NO_DATUM, "", known.label)
    if counts.plants:
        findings.add(SURFACE_PLANTS, "", f"{counts.plants:,} patches, {counts.plants_m2:,.0f} m2")
    far = 100.0 * counts.far / max(counts.cells, 1)
    cut = f"; {counts.cut} long regions are cut where blocks end" if counts.cut else ""
    findings.add(
        SURFACE_SIMPLIFIED,
        "",
        f"{100 - far:.1f} % of {counts.cells:,} cells within {TOLERANCE_M:g} m of their plane{cut}",
    )
