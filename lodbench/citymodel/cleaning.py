"""Cleaning: rings as written to rings that can be meshed, with nothing lost in silence."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel import small_cities
from lodbench.citymodel.codes import DUPLICATE_POINTS, RING_NOT_CLOSED, RING_TOO_SHORT
from lodbench.citymodel.model import Polygons
from lodbench.citymodel.raw import RawCity, starts_of
from lodbench.findings import FindingCode

# Points moved at a time: a few hundred kilobytes are held besides the city.
_CHUNK_POINTS = 1 << 14


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
    mark_points = small_cities.mark_points
    if not small_cities.is_few(raw.points.size):
        from lodbench.kernels.city import mark_points
    mark_points(raw.points, raw.ring_starts, is_kept, new_lengths, is_closed, is_repeated)
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


def _move_up(points: NDArray[np.float64], is_kept: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns the points kept, moved to the front of their array."""
    size = 0
    for n in range(0, len(points), _CHUNK_POINTS):
        block = points[n : n + _CHUNK_POINTS][is_kept[n : n + _CHUNK_POINTS]]
        points[size : size + len(block)] = block
        size += len(block)
    return points[:size]


def _lost_polygons(raw: RawCity, is_short: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tells which polygons have no outline left."""
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
    _report(raw, RING_NOT_CLOSED, ring_building[~is_closed & (lengths > 0) & raw.has_closing_points])
    _report(raw, DUPLICATE_POINTS, ring_building[is_repeated])
    _report(raw, RING_TOO_SHORT, ring_building[is_short])
    _report(raw, RING_TOO_SHORT, raw.building[is_lost & (np.diff(raw.polygon_starts) == 0)])


def _report(raw: RawCity, code: FindingCode, buildings: NDArray[np.int32]) -> None:
    for building in buildings:
        raw.findings.add(code, raw.building_ids[building])
