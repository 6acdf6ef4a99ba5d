"""Cleaning: rings as written to rings that can be meshed, with nothing lost in silence."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel import codes
from lodbench.citymodel.model import (
    HIGHEST_M,
    LOWEST_M,
    TALLEST_M,
    CityObjects,
    Polygons,
    SurfaceKind,
    group_cuts,
    select_polygons,
    starts_of,
    take_segments,
)
from lodbench.citymodel.raw import RawCity
from lodbench.citymodel.scene import HASH_MIXER, HASH_ODD, HASH_SHIFT, number_rows
from lodbench.findings import FindingCode, Findings

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

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
        key *= HASH_ODD
        key ^= key >> HASH_SHIFT
        key *= HASH_MIXER
    key ^= key >> HASH_SHIFT
    hashes = np.zeros((2, len(chosen)), np.uint64)
    filled = np.flatnonzero(np.diff(starts) > 0)
    if len(filled) > 0:
        hashes[0, filled] = np.add.reduceat(key, starts[filled])
        hashes[1, filled] = np.add.reduceat((key * HASH_ODD) ^ (key >> HASH_SHIFT), starts[filled])
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
    """Adds ``FAR_AWAY`` for each building with a point that lies far from most; polygons are in metres."""
    far = np.flatnonzero(far_from_most(polygons.points))
    point_starts = polygons.ring_starts[polygons.polygon_starts]
    polygon = np.searchsorted(point_starts, far, side="right") - 1
    buildings, first = np.unique(polygons.building[polygon], return_index=True)
    for building, n in zip(buildings.tolist(), first.tolist(), strict=True):
        east, north, up = polygons.points[far[n]].tolist()
        where = f"at {east:.0f}, {north:.0f}"
        findings.add(codes.FAR_AWAY, building_ids[building], where, place=(east, north, up))


def unique_ids(ids: Sequence[str], findings: Findings) -> tuple[str, ...]:
    """Returns ids of which no two are equal: what repeats an earlier one gets ``~2``, ``~3`` and so on.

    An export that merged two buildings of one id would lose one of them.

    Args:
        ids: As the file has them.
        findings: Receives ``DUPLICATE_ID``, once per id that repeats.

    Example:
        >>> unique_ids(["a", "b", "a"], Findings())
        ('a', 'b', 'a~2')
    """
    if len(set(ids)) == len(ids):
        return tuple(ids)
    counts = Counter(ids)
    for name, count in counts.items():
        if count > 1:
            findings.add(codes.DUPLICATE_ID, name, f"names {count} objects; the later get ~2 and so on")
    taken, met, unique = set(ids), Counter[str](), []
    for name in ids:
        met[name] += 1
        own = name
        while met[name] > 1 and own in taken:
            own = f"{name}~{met[name]}"
            met[name] += own in taken
        taken.add(own)
        unique.append(own)
    return tuple(unique)


def unique_objects(objects: CityObjects, building_ids: tuple[str, ...], findings: Findings) -> CityObjects:
    """Returns objects of which no two have one id; buildings are called as ``building_ids`` says."""
    ids = list(objects.ids)
    for n, building in enumerate(objects.building.tolist()):
        if objects.parents[n] < 0:
            ids[n] = building_ids[building]
    return replace(objects, ids=unique_ids(ids, findings))


def mend_heights(polygons: Polygons, raw: RawCity, label: str | None) -> None:
    """Puts corners at impossible heights on the ground near them, in place; each building is a finding.

    Impossible is what lies below or above all land, and of a building taller than any the end that is further
    from the heights of the others. The ground is the lowest corner of the nearest building without such
    corners, else the lowest other corner of its own. Where all heights are impossible, their unit or zero is
    another: they stay, and so do those of meshes without a reference system.

    Args:
        polygons: In metres, heights above the sea or the ellipsoid, or of a local frame.
        raw: Names of the buildings, and what they are; its findings grow.
        label: Reference system of the points.
    """
    is_mesh = raw.lods == ("",)
    if len(polygons) == 0 or (is_mesh and label is None):
        return
    z = polygons.points[:, 2]
    lowest_m, highest_m = z.min(), z.max()
    if LOWEST_M < lowest_m and highest_m < HIGHEST_M and highest_m - lowest_m <= TALLEST_M:
        return
    point_polygon = np.repeat(
        np.arange(len(polygons)), np.diff(polygons.ring_starts[polygons.polygon_starts])
    )
    building = polygons.building[point_polygon]
    is_off = ~((z > LOWEST_M) & (z < HIGHEST_M))
    if is_off.all():
        return
    if not is_mesh:  # whose pieces may be mountains
        level = building * (int(polygons.lod.max()) + 1) + polygons.lod[point_polygon]
        is_off |= _wrong_ends(z, level, is_off) & _are_buildings(raw)[building]
    if not is_off.any():
        return
    count = len(raw.building_ids)
    lowest = np.full(count, np.inf)
    np.minimum.at(lowest, building[~is_off], z[~is_off])
    is_hurt = np.zeros(count, np.bool_)
    is_hurt[building[is_off]] = True
    ground = _ground_near(polygons.points, building, lowest, is_hurt)
    order = np.flatnonzero(is_off)
    for number, first in zip(*np.unique(building[order], return_index=True), strict=True):
        own, place = z[order[building[order] == number]], polygons.points[order[first]].copy()
        which = f"{own.min():.10g}" if np.ptp(own) == 0 else f"{own.min():.10g} to {own.max():.10g}"
        detail = f"{len(own)} corners at {which} m, put at {ground[number]:.2f} m"
        east, north, up = place.tolist()
        raw.findings.add(codes.HEIGHT_NO_DATA, raw.building_ids[number], detail, place=(east, north, up))
    z[is_off] = ground[building[is_off]]


def _are_buildings(raw: RawCity) -> Flags:
    """Returns which of a city's objects are buildings, and no terrain or bridge."""
    is_building = np.ones(len(raw.building_ids), np.bool_)
    if raw.objects is not None:
        for number in np.flatnonzero(raw.objects.parents < 0).tolist():
            is_building[raw.objects.building[number]] = "Building" in raw.objects.types[number]
    return is_building


def _wrong_ends(z: Floats, group: NDArray[np.integer], is_off: Flags) -> Flags:
    """Returns which heights are the wrong end of a building, a group, that is taller than any.

    Without another one to compare with it is the lower end: the ground is more often lost than the roof.
    """
    numbers, place = np.unique(group, return_inverse=True)
    low, high = np.full(len(numbers), np.inf), np.full(len(numbers), -np.inf)
    np.minimum.at(low, place[~is_off], z[~is_off])
    np.maximum.at(high, place[~is_off], z[~is_off])
    is_tall = high - low > TALLEST_M
    is_sound = ~is_tall[place] & ~is_off
    middle = float(np.median(z[is_sound])) if is_sound.any() else np.inf
    is_low_end = np.abs(low - middle) >= np.abs(high - middle) if is_sound.any() else is_tall
    half = 0.5 * (low + np.where(is_tall, high, low))
    is_wrong: Flags = is_tall[place] & np.where(is_low_end[place], z < half[place], z > half[place])
    return is_wrong


def _ground_near(points: Floats, building: NDArray[np.integer], lowest: Floats, is_hurt: Flags) -> Floats:
    """Returns (B,) the lowest corner of each building; of the hurt ones that of the nearest that is sound."""
    from scipy.spatial import cKDTree

    sizes = np.maximum(np.bincount(building, minlength=len(lowest)), 1)
    middles = np.stack(
        [np.bincount(building, points[:, k], minlength=len(lowest)) / sizes for k in (0, 1)], axis=1
    )
    ground = np.where(np.isfinite(lowest), lowest, 0.0)
    sound = np.flatnonzero(~is_hurt & np.isfinite(lowest))
    hurt = np.flatnonzero(is_hurt)
    if len(sound):
        ground[hurt] = lowest[sound[cKDTree(middles[sound]).query(middles[hurt])[1]]]
    elif np.isfinite(lowest).any():
        ground[hurt] = np.where(np.isfinite(lowest[hurt]), lowest[hurt], lowest.min())
    return ground
