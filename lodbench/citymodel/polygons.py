"""Cleaning: raw rings to polygons that can be meshed, in the local frame, with nothing lost in silence."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.bases import move_bases
from lodbench.citymodel.codes import CRS_MIXED, DUPLICATE_POINTS, RING_NOT_CLOSED, RING_TOO_SHORT
from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.duplicates import drop_repeated_solids
from lodbench.citymodel.frame import to_metres
from lodbench.citymodel.model import CityModel, Polygons
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.raw import RawCity, starts_of, take_segments
from lodbench.errors import CityModelError
from lodbench.findings import FindingCode, Findings

# Far more than any false easting; float32 and projections stay sound below it.
_MAX_COORDINATE_M = 1e9


def finish_model(raw: RawCity, options: ReadOptions | None = None) -> CityModel:
    """Returns a raw city as a model: metres, local frame, clean rings, levels in ascending order.

    Args:
        raw: What a reader found.
        options: Reference system, axis order and origin where the user names them. By default the
            origin is in whole metres at the south-west corner, its height 0.

    Raises:
        CityModelError: Coordinates are not finite, or their reference system cannot be settled.
    """
    if not np.isfinite(raw.points).all():
        raise CityModelError(
            f"{raw.source} has coordinates that are not finite numbers.",
            "See which: lodbench city check FILE.",
        )
    options = options or ReadOptions()
    points, label = _in_metres(raw, options)
    points = move_bases(points, raw, label, options)
    if len(points) and np.abs(points).max() > _MAX_COORDINATE_M:
        raise CityModelError(
            f"{raw.source} has coordinates that lie nowhere on Earth, in metres.",
            "Is the reference system right? crs= names another.",
        )
    origin = np.zeros(3) if options.origin is None else np.asarray(options.origin, np.float64)
    if options.origin is None and len(points) and (label is not None or np.abs(points).max() > 1e4):
        origin[:2] = np.floor(points[:, :2].min(axis=0))
    if raw.srs_names or options.origin is None:
        # In place where it is a copy already: the points are most of the memory a city needs.
        points = np.subtract(points, origin, out=None if points is raw.points else points)
    # Else the format has a frame of its own, and the origin is where the user says that frame lies.
    order = sorted(range(len(raw.lods)), key=lambda i: raw.lods[i])
    rank = np.argsort(np.asarray(order, np.int64)) if order else np.zeros(0, np.int64)
    return CityModel(
        source=raw.source,
        format=raw.format,
        version=raw.version,
        crs=label,
        origin=origin,
        building_ids=raw.building_ids,
        num_parts=raw.num_parts,
        lods=tuple(raw.lods[i] for i in order),
        polygons=drop_repeated_solids(_clean(raw, points, rank), raw.building_ids, raw.findings),
        polygons_read=tuple(np.bincount(raw.lod, minlength=len(order))[order].tolist()),
        findings=raw.findings,
    )


def _in_metres(raw: RawCity, options: ReadOptions) -> tuple[NDArray[np.float64], str | None]:
    """Returns all points in metres of one reference system: that of the first polygon."""
    override = options.crs
    if not raw.srs_names and options.origin is not None:
        return raw.points, None if override is None else require_crs(override).label
    order = options.axis_order if options.axis_order != "auto" else raw.axis_order
    if not raw.srs_names and override is None:
        return raw.points, None  # a format that cannot name a reference system
    used = np.unique(raw.srs)
    if len(used) <= 1 or override is not None:
        name = raw.srs_names[used[0]] if len(used) and raw.srs_names else None
        return to_metres(raw.points, name, override, raw.findings, order)
    ring_srs = np.repeat(raw.srs, np.diff(raw.polygon_starts))
    point_srs = np.repeat(ring_srs, np.diff(raw.ring_starts))
    points = np.zeros_like(raw.points)
    first_label: str | None = None
    for rank, srs in enumerate([int(raw.srs[0]), *(int(s) for s in used if s != raw.srs[0])]):
        chosen = point_srs == srs
        points[chosen], label = to_metres(raw.points[chosen], raw.srs_names[srs], None, raw.findings, order)
        if rank == 0:
            first_label = label
        elif label is not None and first_label is not None and label != first_label:
            points[chosen] = _reproject(points[chosen], label, first_label)
            raw.findings.add(CRS_MIXED, "", f"{label} brought to {first_label}")
    return points, first_label


def _reproject(points: NDArray[np.float64], label: str, target: str) -> NDArray[np.float64]:
    from pyproj import Transformer

    source_crs, target_crs = require_crs(label).horizontal, require_crs(target).horizontal
    if source_crs == target_crs:
        return points
    transformer = Transformer.from_crs(source_crs, target_crs, always_xy=True)
    east, north = transformer.transform(points[:, 0], points[:, 1])
    return np.stack([east, north, points[:, 2]], axis=1)


def _clean(raw: RawCity, points: NDArray[np.float64], lod_rank: NDArray[np.int64]) -> Polygons:
    """Removes closing and repeated points, then rings and polygons that are too short."""
    starts, lengths = raw.ring_starts, np.diff(raw.ring_starts)
    num_rings = len(lengths)
    ring_building = np.repeat(raw.building, np.diff(raw.polygon_starts))
    kept = np.ones(len(points), np.bool_)
    filled = np.flatnonzero(lengths > 0)
    first, last = starts[filled], starts[filled + 1] - 1
    same_as_next = np.zeros(len(points), np.bool_)
    same_as_next[:-1] = np.all(raw.points[1:] == raw.points[:-1], axis=1)
    same_as_next[last] = False
    is_closed = np.all(raw.points[first] == raw.points[last], axis=1) & (lengths[filled] > 1)
    kept[last[is_closed]] = False
    kept &= ~same_as_next
    if raw.has_closing_points:
        _report(raw, RING_NOT_CLOSED, ring_building[filled[~is_closed]])
    else:
        # In formats without closing points a closing point is a repeat.
        same_as_next[last[is_closed]] = True
    point_ring = np.repeat(np.arange(num_rings), lengths)
    repeated = np.bincount(point_ring[same_as_next], minlength=num_rings) > 0
    _report(raw, DUPLICATE_POINTS, ring_building[repeated])

    new_lengths = np.bincount(point_ring[kept], minlength=num_rings)
    is_short = new_lengths < 3
    _report(raw, RING_TOO_SHORT, ring_building[is_short])
    is_lost = _lost_polygons(raw, is_short)
    _report(raw, RING_TOO_SHORT, raw.building[is_lost & (np.diff(raw.polygon_starts) == 0)])
    clean = points[kept]
    new_starts = starts_of(new_lengths)
    polygon_counts = np.diff(raw.polygon_starts)
    if is_short.any() or is_lost.any():
        ring_kept = ~is_short & ~np.repeat(is_lost, polygon_counts)
        items, new_starts = take_segments(new_starts, np.flatnonzero(ring_kept))
        clean = clean[items]
        ring_polygon = np.repeat(np.arange(len(polygon_counts)), polygon_counts)
        polygon_counts = np.bincount(ring_polygon[ring_kept], minlength=len(polygon_counts))[~is_lost]
    return Polygons(
        points=clean,
        ring_starts=new_starts,
        polygon_starts=starts_of(polygon_counts),
        building=raw.building[~is_lost],
        lod=lod_rank[raw.lod[~is_lost]].astype(np.int16),
        kind=raw.kind[~is_lost],
    )


def _lost_polygons(raw: RawCity, is_short: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tells which polygons have no outline left."""
    counts = np.diff(raw.polygon_starts)
    is_lost: NDArray[np.bool_] = counts == 0
    has_rings = np.flatnonzero(~is_lost)
    is_lost[has_rings] = is_short[raw.polygon_starts[has_rings]]
    return is_lost


def _report(raw: RawCity, code: FindingCode, buildings: NDArray[np.int32]) -> None:
    findings: Findings = raw.findings
    for building in buildings:
        findings.add(code, raw.building_ids[building])
