"""Cleaning: rings as written to rings that can be meshed, with nothing lost in silence."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel import codes
from lodbench.citymodel.lods import group_cuts, select_polygons
from lodbench.citymodel.model import Polygons, SurfaceKind
from lodbench.citymodel.raw import RawCity, starts_of, take_segments
from lodbench.findings import FindingCode, Findings

# Points moved at a time: a few hundred kilobytes are held besides the city.
_CHUNK_POINTS = 1 << 14
# Rings looked at at a time: what is held of them fits the cache.
_CHUNK_RINGS = 1 << 12


def clean_polygons(raw: RawCity) -> tuple[Polygons, NDArray[np.int64]]:
    """Removes closing and repeated points, then rings and polygons that are too short.

    Points stay in the coordinates of the file, where "equal" means equal as written.

    Args:
        raw: What a reader found; its points are used up, its findings added to.

    Returns:
        polygons: What is left; its points are those of ``raw``, moved up in place.
        kept: (N,) indices of its polygons among those of ``raw``.
    """
    lengths = np.diff(raw.ring_starts)
    marks = np.zeros((3, len(lengths)), np.bool_)
    is_closed, is_repeated, is_short = marks
    is_kept = np.empty(len(raw.points), np.bool_)
    new_lengths = np.zeros(len(lengths), np.int64)
    for first in range(0, len(lengths), _CHUNK_RINGS):
        part = slice(first, first + _CHUNK_RINGS)
        starts = raw.ring_starts[first : first + _CHUNK_RINGS + 1]
        points = slice(starts[0], starts[-1])
        of_rings = new_lengths[part], is_closed[part], is_repeated[part]
        _mark_points(raw.points[points], starts - starts[0], is_kept[points], *of_rings)
    np.less(new_lengths, 3, out=is_short)
    # In formats without closing points a closing point is a repeat.
    is_repeated |= is_closed & np.logical_not(raw.has_closing_points)
    is_lost = _lost_polygons(raw, is_short)
    _report_rings(raw, marks, lengths, is_lost)

    polygon_counts = np.diff(raw.polygon_starts)
    is_ring_kept = ~is_short & ~np.repeat(is_lost, polygon_counts)
    if is_short.any() or is_lost.any():  # a polygon without a ring is lost, and no ring with it
        is_kept &= np.repeat(is_ring_kept, lengths)
        new_lengths = new_lengths[is_ring_kept]
        ring_polygon = np.repeat(np.arange(len(polygon_counts)), polygon_counts)
        polygon_counts = np.bincount(ring_polygon[is_ring_kept], minlength=len(polygon_counts))[~is_lost]
    kept = np.flatnonzero(~is_lost)
    polygons = Polygons(
        points=_move_up(raw.points, is_kept),
        ring_starts=starts_of(new_lengths),
        polygon_starts=starts_of(polygon_counts),
        building=raw.building[kept],
        lod=raw.lod[kept],
        kind=raw.kind[kept],
        part=None if raw.part is None else raw.part[kept],
        picture=None if raw.picture is None else raw.picture[kept],
        uv=None if raw.uv is None else raw.uv[is_kept],
    )
    return polygons, kept


def _mark_points(
    points: NDArray[np.float64],
    starts: NDArray[np.int64],
    is_kept: NDArray[np.bool_],
    lengths: NDArray[np.int64],
    is_closed: NDArray[np.bool_],
    is_repeated: NDArray[np.bool_],
) -> None:
    """Fills which points stay, how many of each ring, which rings are closed and which repeat a point."""
    rings = np.flatnonzero(np.diff(starts) > 0)
    if len(rings) == 0:
        return
    first, last = starts[rings], starts[rings + 1] - 1
    differs = points[1:] != points[:-1]
    is_kept[:-1] = differs[:, 0] | differs[:, 1] | differs[:, 2]
    is_kept[last] = True
    is_closed[rings] = (first < last) & (points[first] == points[last]).all(axis=1)
    kept = np.add.reduceat(is_kept, first, dtype=np.int64)
    is_repeated[rings] = kept < last - first + 1
    is_kept[last] = ~is_closed[rings]
    lengths[rings] = kept - is_closed[rings]


def _move_up(points: NDArray[np.float64], is_kept: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns the points kept, moved to the front of their array."""
    size = 0
    for n in range(0, len(points), _CHUNK_POINTS):
        block = points[n : n + _CHUNK_POINTS][is_kept[n : n + _CHUNK_POINTS]]
        points[size : size + len(block)] = block
        size += len(block)
    return points[:size]


def _lost_polygons(raw: RawCity, is_short: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns which polygons have no outline left."""
    is_lost: NDArray[np.bool_] = np.diff(raw.polygon_starts) == 0
    has_rings = np.flatnonzero(~is_lost)
    is_lost[has_rings] = is_short[raw.polygon_starts[has_rings]]
    return is_lost


def _report_rings(
    raw: RawCity, marks: NDArray[np.bool_], lengths: NDArray[np.int64], is_lost: NDArray[np.bool_]
) -> None:
    """Adds the findings of rings, and of polygons that had none."""
    is_closed, is_repeated, is_short = marks
    ring_building = np.repeat(raw.building, np.diff(raw.polygon_starts))
    _report(raw, codes.RING_NOT_CLOSED, ring_building[~is_closed & (lengths > 0) & raw.has_closing_points])
    _report(raw, codes.DUPLICATE_POINTS, ring_building[is_repeated])
    _report(raw, codes.RING_TOO_SHORT, ring_building[is_short])
    _report(raw, codes.RING_TOO_SHORT, raw.building[is_lost & (np.diff(raw.polygon_starts) == 0)])


def _report(raw: RawCity, code: FindingCode, buildings: NDArray[np.int32]) -> None:
    for building in buildings:
        raw.findings.add(code, raw.building_ids[building])


# Polygons compared at a time: what is held of them, some hundred bytes each, fits the cache.
_BLOCK_POLYGONS = 1 << 12
# An odd number (2**64 over the golden ratio) and one of splitmix64, which spread bits.
_ODD, _MIXER, _SHIFT = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(31)


def drop_repeats(
    polygons: Polygons, building_ids: tuple[str, ...], findings: Findings
) -> tuple[Polygons, NDArray[np.int64], NDArray[np.int64]]:
    """Returns the polygons less those that stand twice in a building at one level.

    XLinks say so; some writers copy the coordinates instead, and the area would count twice. Two polygons
    are the same when they have the same corners, whichever way round. Of a surface and the face of a
    solid the surface is kept, whatever the part; of two faces of one kind the first, within a part:
    walls that two parts share are walls of both. Interiors are their own.

    Returns:
        polygons: What is left.
        kept_as: (N,) the index among them of each polygon given, or of what it repeats.
        kept: (M,) the index among those given of each polygon left.
    """
    kept_as = np.arange(len(polygons))
    building = polygons.building
    order = np.arange(len(polygons))
    if np.any(building[1:] < building[:-1]):
        order = np.argsort(building, kind="stable")
    for first, last in pairwise(group_cuts(building[order], _BLOCK_POLYGONS)):
        _find_repeats(polygons, order[first:last], kept_as)
    is_kept = kept_as == np.arange(len(polygons))
    if is_kept.all():
        return polygons, kept_as, kept_as
    for owner in building[~is_kept].tolist():
        findings.add(codes.DUPLICATE_POLYGON, building_ids[owner])
    rank = np.cumsum(is_kept) - 1
    kept = np.flatnonzero(is_kept)
    return select_polygons(polygons, kept), rank[kept_as], kept


def _find_repeats(polygons: Polygons, chosen: NDArray[np.int64], kept_as: NDArray[np.int64]) -> None:
    """Writes which polygon each of the chosen repeats, if any; the chosen are whole buildings."""
    hashes = _hash_corners(polygons, chosen)
    is_interior = polygons.kind[chosen] == SurfaceKind.INTERIOR
    owner = polygons.building[chosen].astype(np.uint64)
    # Most cities repeat nothing, which one sort of short keys tells.
    keys = np.sort(hashes[0] ^ (owner << np.uint64(32)))
    if not np.any(keys[1:] == keys[:-1]):
        return
    columns = [owner, polygons.lod[chosen].astype(np.uint64), is_interior.astype(np.uint64), *hashes]
    number, _ = number_rows(columns)
    sizes = np.bincount(number)
    twice = np.flatnonzero((sizes[number] > 1) & ~is_interior)
    if len(twice) == 0:
        return
    part = polygons.building if polygons.part is None else polygons.part
    polygon, group = chosen[twice], number[twice]
    is_surface = polygons.kind[polygon] != SurfaceKind.UNKNOWN
    first_surface = np.full(len(sizes), -1, np.int64)
    first_surface[group[is_surface][::-1]] = polygon[is_surface][::-1]  # the first of a group is written last
    stand_in = first_surface[group]
    # Among surfaces, and among faces that no surface repeats, the first of each part stays.
    own = np.flatnonzero(is_surface | (stand_in < 0))
    rank, first = number_rows([group[own].astype(np.uint64), part[polygon[own]].astype(np.uint64)])
    stand_in[own] = polygon[own[first[rank]]]
    kept_as[polygon] = stand_in


def _hash_corners(polygons: Polygons, chosen: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Returns (2, C) 64-bit sums over the corners of each chosen polygon, equal for equal sets of corners."""
    corners, starts = take_segments(polygons.ring_starts[polygons.polygon_starts], chosen)
    key = np.zeros(len(corners), np.uint64)
    for column in np.take(polygons.points, corners, axis=0).T:
        key ^= (column + 0.0).view(np.uint64)  # -0 is 0
        key *= _ODD
        key ^= key >> _SHIFT
        key *= _MIXER
    key ^= key >> _SHIFT
    hashes = np.zeros((2, len(chosen)), np.uint64)
    filled = np.flatnonzero(np.diff(starts) > 0)
    if len(filled) > 0:
        hashes[0, filled] = np.add.reduceat(key, starts[filled])
        hashes[1, filled] = np.add.reduceat((key * _ODD) ^ (key >> _SHIFT), starts[filled])
    hashes[0] += np.diff(starts).astype(np.uint64)
    return hashes


# So far from a frame's origin float32 is 2 cm off; few countries are as wide.
_FAR_M = 500_000.0


def frame_origin(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns whole metres at the south-west corner of points, (P, 3), strays left out; its height is 0."""
    is_far = far_from_most(points)
    near = points[~is_far] if is_far.any() else points
    return np.array([np.floor(near[:, 0].min()), np.floor(near[:, 1].min()), 0.0])


def far_from_most(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns which points, (P, 3), lie more than 500 km from the middle of all: a zero that was no place."""
    plane = points[:, :2]
    if max(np.ptp(plane[:, 0]), np.ptp(plane[:, 1])) <= _FAR_M:  # along rows it takes 20 times as long
        return np.zeros(len(points), np.bool_)
    middle = np.median(plane, axis=0)
    # Of two halves the middle may be nowhere: the point next to it is somewhere.
    middle = plane[np.argmin(np.abs(plane - middle).sum(axis=1))]
    return np.asarray(np.abs(plane - middle).max(axis=1) > _FAR_M)


def report_outliers(polygons: Polygons, building_ids: tuple[str, ...], findings: Findings) -> None:
    """Adds a finding for each building with a point that lies far from most.

    Args:
        polygons: In metres of one reference system.
        building_ids: For the findings.
        findings: Receives ``FAR_AWAY``.
    """
    far = np.flatnonzero(far_from_most(polygons.points))
    point_starts = polygons.ring_starts[polygons.polygon_starts]
    polygon = np.searchsorted(point_starts, far, side="right") - 1
    buildings, first = np.unique(polygons.building[polygon], return_index=True)
    for building, n in zip(buildings.tolist(), first.tolist(), strict=True):
        east, north, up = polygons.points[far[n]].tolist()
        where = f"at {east:.0f}, {north:.0f}"
        findings.add(codes.FAR_AWAY, building_ids[building], where, place=(east, north, up))


def number_rows(columns: list[NDArray[np.uint64]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns a number for every row, equal for equal rows, and the first row of each number.

    Numbers count up in the order of first occurrence.

    Args:
        columns: Arrays (N,) of bits; a row is one entry of each.

    Returns:
        numbers: (N,) int64.
        first: (U,) int64 ascending.

    Example:
        >>> number_rows([np.array([7, 5, 7], np.uint64)])[0]
        array([0, 1, 0])
    """
    key = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        key = (key ^ column) * _MULTIPLIER
        key = (key ^ (key >> _SHIFT)) * _MIXER
    order = np.argsort(key, kind="stable")
    is_new = _changes([key], order)
    if not np.array_equal(is_new, _changes(columns, order)):
        # Two rows share a hash: sort by the rows themselves.
        order = np.lexsort(columns)
        is_new = _changes(columns, order)
    group = np.cumsum(is_new) - 1
    first = order[is_new]  # a stable sort keeps the earliest row of a group in front
    by_occurrence = np.argsort(first)
    rank = np.empty_like(by_occurrence)
    rank[by_occurrence] = np.arange(len(first))
    numbers = np.empty(len(order), np.int64)
    numbers[order] = rank[group]
    return numbers, first[by_occurrence]


def connected_components(
    num_nodes: int, first: NDArray[np.int64], second: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Returns the smallest node of each node's component.

    Args:
        num_nodes: Nodes are 0 .. num_nodes - 1.
        first: (E,) one end of every edge.
        second: (E,) the other end.
    """
    from scipy.sparse import coo_array, csgraph

    edges = coo_array((np.ones(len(first), np.bool_), (first, second)), shape=(num_nodes, num_nodes))
    count, labels = csgraph.connected_components(edges, directed=False)
    smallest: NDArray[np.int64] = np.full(count, num_nodes, np.int64)
    np.minimum.at(smallest, labels, np.arange(num_nodes))
    return np.asarray(smallest[labels])


# Odd constants with well spread bits (from the golden ratio and the splitmix64 finaliser).
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)


_MIXER = np.uint64(0xBF58476D1CE4E5B9)


_SHIFT = np.uint64(31)


def _changes(columns: list[NDArray[np.uint64]], order: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Returns where a row differs from the one before it in the given order."""
    is_new = np.zeros(len(order), np.bool_)
    is_new[:1] = True
    for column in columns:
        ordered = column[order]
        is_new[1:] |= ordered[1:] != ordered[:-1]
    return is_new


def point_bits(points: NDArray[np.floating]) -> list[NDArray[np.uint64]]:
    """Returns the bits of points, (N, 3) of any float type, as three columns; -0.0 counts as 0.0."""
    word = np.uint32 if points.dtype == np.float32 else np.uint64
    bits = np.ascontiguousarray((points + points.dtype.type(0)).T).view(word)
    return [column.astype(np.uint64) for column in bits]
