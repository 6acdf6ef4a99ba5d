"""From what a reader hands over to a city model: clean rings, in metres, in the local frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.axis_order import faces_tell_north_first
from lodbench.citymodel.cleaning import clean_polygons, drop_repeats, frame_origin, report_outliers
from lodbench.citymodel.codes import CRS_MIXED, DUPLICATE_ID
from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.frame import bring_to, brought_note, require_no_degrees, to_metres
from lodbench.citymodel.lods import select_polygons
from lodbench.citymodel.model import CityModel, CityObjects, Polygons, Solids
from lodbench.citymodel.options import INTERIORS, ReadOptions
from lodbench.citymodel.pictures import Pictures
from lodbench.citymodel.raw import RawCity
from lodbench.citymodel.terrain import mend_heights, move_bases, tell_unused
from lodbench.citymodel.triangulate import newell
from lodbench.errors import CityModelError
from lodbench.findings import Findings
from lodbench.geometry.similarity import ShiftedEcef

# Far more than any false easting; float32 and projections stay sound below it.
_MAX_COORDINATE_M = 1e9
# Coordinates of a reference system nobody names: larger than any local frame.
_MAX_LOCAL_M = 1e4


def finish_model(raw: RawCity, options: ReadOptions | None = None) -> CityModel:
    """Returns a raw city as a model: metres, local frame, clean rings, levels in ascending order.

    Args:
        raw: What a reader found; it is used up.
        options: Reference system, axis order and origin where the user names them. By default the
            origin is in whole metres at the south-west corner, its height 0; a stray does not move it.

    Raises:
        CityModelError: Coordinates are not finite, or their reference system cannot be settled.
    """
    options = options or ReadOptions()
    if raw.pitched is not None and len(raw.pitched) != len(raw.building_ids):
        raise CityModelError(f"The reader of {raw.source} gives roofs for buildings that it did not read.")
    _make_points_writable(raw)
    raw.building_ids = unique_ids(raw.building_ids, raw.findings)
    objects = None if raw.objects is None else unique_objects(raw.objects, raw.building_ids, raw.findings)
    num_read = np.bincount(raw.lod, minlength=len(raw.lods))
    # A level that only empty elements name is none: by default the lowest there is would be taken.
    order = sorted(np.flatnonzero(num_read).tolist(), key=lambda i: raw.lods[i])
    polygons, kept = clean_polygons(raw)
    label, origin = _bring_to_local_frame(polygons, raw.srs[kept], raw, options)
    rank = np.zeros(len(raw.lods), np.int16)
    rank[order] = np.arange(len(order))
    polygons = replace(polygons, lod=rank[polygons.lod])
    first_kept = kept_as = np.arange(len(polygons))
    given = polygons
    if raw.lods != ("",):  # a mesh is what its triangles are: of two parts that touch, both have their wall
        polygons, kept_as, first_kept = drop_repeats(polygons, raw.building_ids, raw.findings)
    pictures = _lost_pictures(raw.pictures, given, polygons, kept_as)
    solids = raw.solids
    if solids is not None:
        is_turned = _is_turned(given, first_kept[kept_as])
        solids = _renumbered(solids, len(raw.building), kept, kept_as, is_turned)
    return CityModel(
        source=raw.source,
        format=raw.format,
        version=raw.version,
        crs=label,
        origin=origin,
        building_ids=raw.building_ids,
        num_parts=raw.num_parts,
        lods=tuple(raw.lods[i] for i in order),
        polygons=polygons,
        polygons_read=tuple(num_read[order].tolist()),
        findings=raw.findings,
        objects=objects,
        solids=solids,
        polygon_ids=tuple(raw.polygon_ids[n] for n in kept[first_kept].tolist()) if raw.polygon_ids else (),
        has_interiors=INTERIORS in options.layers,
        has_textures=raw.has_textures,
        pictures=pictures,
        pitched=raw.pitched,
        measured_m=raw.measured_m,
        period=raw.period,
    )


def _make_points_writable(raw: RawCity) -> None:
    """Lets the points be changed in place.

    Raises:
        CityModelError: One is not finite.
    """
    raw.points = np.require(raw.points, np.float64, ["C", "W"])
    if not np.isfinite(_largest(raw.points)):
        raise CityModelError(
            f"{raw.source} has coordinates that are not finite numbers.",
            "See which: lodbench city check FILE.",
        )


def _bring_to_local_frame(
    polygons: Polygons, srs: NDArray[np.int16], raw: RawCity, options: ReadOptions
) -> tuple[str | None, NDArray[np.float64]]:
    """Changes points to metres of a local frame; returns its reference system, and its origin, (3,)."""
    label = _bring_to_metres(polygons, srs, raw, options)
    if options.ecef_origin is not None:
        polygons.points[:] = ShiftedEcef(*options.ecef_origin).points_to_enu(polygons.points)
    tell_unused(raw.format, options, raw.findings)
    mend_heights(polygons, raw, label)
    move_bases(polygons, raw.building_ids, label, options, raw.findings)
    return label, _subtract_origin(polygons, label, raw, options)


def _renumbered(
    solids: Solids,
    num_read: int,
    kept: NDArray[np.int64],
    kept_as: NDArray[np.int64],
    is_turned: NDArray[np.bool_],
) -> Solids:
    """Returns solids of polygons that were read as solids of those that stand for them, -1 for none.

    Args:
        solids: Their faces are numbers below ``num_read``, or -1.
        num_read: How many polygons there were.
        kept: (N,) which of them are clean.
        kept_as: (N,) which polygon stands for each of these.
        is_turned: (N,) whether that one looks the other way.
    """
    places, turned = np.full(num_read + 1, -1, np.int64), np.zeros(num_read + 1, np.bool_)
    places[kept], turned[kept] = kept_as, is_turned
    return replace(solids, faces=places[solids.faces], is_flipped=solids.is_flipped ^ turned[solids.faces])


def _lost_pictures(
    pictures: Pictures | None, given: Polygons, kept: Polygons, kept_as: NDArray[np.int64]
) -> Pictures | None:
    """Returns the pictures with a note of surfaces written twice of which the one without picture stays."""
    if pictures is None or given.picture is None or kept.picture is None:
        return pictures
    count = int(((given.picture >= 0) & (kept.picture[kept_as] < 0)).sum())
    note = f"{count} x picture of a surface that is written again without one"
    return replace(pictures, notes=(*pictures.notes, note)) if count else pictures


def _is_turned(polygons: Polygons, stand_in: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Returns which polygons look the other way than the one of the same corners that is kept for them."""
    is_turned = np.zeros(len(polygons), np.bool_)
    dropped = np.flatnonzero(stand_in != np.arange(len(polygons)))
    if len(dropped):
        own, other = (newell(select_polygons(polygons, which))[0] for which in (dropped, stand_in[dropped]))
        is_turned[dropped] = np.einsum("ij,ij->i", own, other) < 0
    return is_turned


def _largest(points: NDArray[np.float64]) -> float:
    """Returns the largest absolute coordinate, NaN where one is NaN, 0 without any; no copy is made."""
    return float(np.maximum(points.max(), -points.min())) if points.size else 0.0


def _check_reach(points: NDArray[np.float64], source: str) -> None:
    """Raises CityModelError where a coordinate lies nowhere on Earth, and says which."""
    if _largest(points) <= _MAX_COORDINATE_M:
        return
    worst = np.abs(points).max(axis=0)
    if worst[:2].max() <= _MAX_COORDINATE_M:
        count = int((np.abs(points[:, 2]) > _MAX_COORDINATE_M).sum())
        raise CityModelError(
            f"{source} has {count} of {len(points)} heights nowhere on Earth, up to {worst[2]:.4g} m.",
            "Mend the file: the reference system of the plane is not at fault.",
        )
    raise CityModelError(
        f"{source} has coordinates that lie nowhere on Earth, in metres (up to {worst.max():.4g}).",
        "Is the reference system right? `crs=` names another.",
    )


def _subtract_origin(
    polygons: Polygons, label: str | None, raw: RawCity, options: ReadOptions
) -> NDArray[np.float64]:
    """Returns the origin of the local frame, taken off the points in place."""
    points = polygons.points
    _check_reach(points, raw.source)
    if options.origin is not None:
        origin = np.asarray(options.origin, np.float64)
        if raw.srs_names:
            points -= origin
        # Else the format has a frame of its own, and the origin is where the user says it lies.
        return origin
    if not len(points) or (label is None and _largest(points) <= _MAX_LOCAL_M):
        return np.zeros(3)
    report_outliers(polygons, raw.building_ids, raw.findings)
    origin = frame_origin(points)
    points -= origin
    return origin


def _bring_to_metres(
    polygons: Polygons, srs: NDArray[np.int16], raw: RawCity, options: ReadOptions
) -> str | None:
    """Brings all points, in place, to metres of one reference system: the first that is known.

    Args:
        polygons: In the coordinates of the file.
        srs: (N,) the reference system of each, as in ``RawCity``.
        raw: Names and findings.
        options: ``crs``, ``axis_order``, ``origin``.

    Returns:
        The label of that system, or None where there is none.
    """
    override, points = options.crs, polygons.points
    if not raw.srs_names and options.origin is not None:
        return None if override is None else require_crs(override).metric_label
    if not raw.srs_names and override is None:
        require_no_degrees(points)
        return None  # a format that cannot name a reference system
    systems = raw.systems()
    if options.axis_order != "auto":
        systems = tuple((name, options.axis_order) for name, _ in systems)
    used = np.unique(srs)
    if len({systems[n] if override is None else systems[n][1] for n in used}) <= 1:
        name, order = systems[used[0] if len(used) else 0]
        return to_metres(
            points, name, override, raw.findings, order, partial(_told_by_faces, raw, polygons, None)
        )
    point_srs = np.repeat(srs, np.diff(polygons.ring_starts[polygons.polygon_starts]))
    first_label: str | None = None
    for number in [int(srs[0]), *(int(s) for s in used if s != srs[0])]:
        is_chosen = point_srs == number
        part = points[is_chosen]
        name, order = systems[number]
        faces = partial(_told_by_faces, raw, polygons, srs == number)
        label = to_metres(part, name, override, raw.findings, order, faces)
        if first_label is None:
            first_label = label
        elif label is not None and label != first_label:
            bring_to(part, label, first_label)
            raw.findings.add(CRS_MIXED, "", brought_note(label, first_label))
        points[is_chosen] = part
    return first_label


def _told_by_faces(
    raw: RawCity, polygons: Polygons, is_chosen: NDArray[np.bool_] | None, least_buildings: int
) -> bool | None:
    """Returns whether northings stand first in polygons of a reference system; meshes have x to the east."""
    if raw.lods == ("",):
        return None
    chosen = polygons if is_chosen is None else select_polygons(polygons, np.flatnonzero(is_chosen))
    return faces_tell_north_first(chosen, least_buildings)


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
            findings.add(DUPLICATE_ID, name, f"names {count} objects; the later get ~2 and so on")
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
