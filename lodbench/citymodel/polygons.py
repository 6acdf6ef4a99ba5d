"""From what a reader hands over to a city model: clean rings, in metres, in the local frame."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.cleaning import (
    clean_polygons,
    drop_repeats,
    frame_origin,
    mend_heights,
    report_outliers,
    unique_ids,
    unique_objects,
)
from lodbench.citymodel.codes import BASE_MOVED, CRS_MIXED, GROUND_DEFAULTED, OPTION_UNUSED
from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.frame import bring_to, brought_note, require_no_degrees, to_metres
from lodbench.citymodel.model import CityModel, Pictures, Polygons, Solids, select_polygons
from lodbench.citymodel.options import INTERIORS, ReadOptions
from lodbench.citymodel.raw import RawCity
from lodbench.citymodel.triangulate import newell
from lodbench.errors import CityModelError
from lodbench.findings import Findings

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
    """Lets the points be changed in place."""
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
        from lodbench.geometry.similarity import ShiftedEcef

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
    """Returns solids of polygons that were read as solids of those that stand for them, -1 for none."""
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
    """Brings all points, in place, to metres of one reference system: the first that is known."""
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
            points, name, override, raw.findings, order, partial(_faces_north_first, raw, polygons, None)
        )
    point_srs = np.repeat(srs, np.diff(polygons.ring_starts[polygons.polygon_starts]))
    first_label: str | None = None
    for number in [int(srs[0]), *(int(s) for s in used if s != srs[0])]:
        is_chosen = point_srs == number
        part = points[is_chosen]
        name, order = systems[number]
        faces = partial(_faces_north_first, raw, polygons, srs == number)
        label = to_metres(part, name, override, raw.findings, order, faces)
        if first_label is None:
            first_label = label
        elif label is not None and label != first_label:
            bring_to(part, label, first_label)
            raw.findings.add(CRS_MIXED, "", brought_note(label, first_label))
        points[is_chosen] = part
    return first_label


def _faces_north_first(
    raw: RawCity, polygons: Polygons, is_chosen: NDArray[np.bool_] | None, least_buildings: int
) -> bool | None:
    """Returns whether northings stand first in polygons of a reference system; meshes have x to the east."""
    if raw.lods == ("",):
        return None
    chosen = polygons if is_chosen is None else select_polygons(polygons, np.flatnonzero(is_chosen))
    return faces_tell_north_first(chosen, least_buildings)


def tell_unused(format: str, options: ReadOptions, findings: Findings) -> None:
    """Adds a finding for every option that was given and that a city of this format does not hear."""
    unheard = {}
    if format not in _FOOTPRINTS:
        unheard = {name: f"{name}: it is of footprints" for name in _OF_FOOTPRINTS}
        if options.base != "ground":
            unheard |= {name: f"{name}: base=ground sets buildings on the ground" for name in _OF_GROUND}
    if format in _UPRIGHT:
        unheard["up_axis"] = "up_axis: it is of meshes"
    if not format.startswith("City"):
        unheard["date"] = "date: it is of CityGML and CityJSON"
    usual = ReadOptions()
    for name, why in unheard.items():
        if getattr(options, name) != getattr(usual, name):
            findings.add(OPTION_UNUSED, "", why)


# What formats of footprints alone are read by, and what sets buildings on the ground where that is requested.
_FOOTPRINTS = ("footprints", "surfaces")

_OF_FOOTPRINTS = (
    "layer", "height_column", "storeys_column", "storey_height_m", "ground_column", "default_height_m",
)  # fmt: skip

_OF_GROUND = ("ground_m", "terrain")

# What has its heights in z, whatever is requested.
_UPRIGHT = (*_FOOTPRINTS, "CityGML", "CityJSON", "CityJSONSeq")


def move_bases(
    polygons: Polygons,
    building_ids: tuple[str, ...],
    label: str | None,
    options: ReadOptions,
    findings: Findings,
) -> None:
    """Moves the bottoms of buildings, in place, as ``options.base`` says.

    ``ground`` adds the terrain height under each building's middle (or ``ground_m``) to all its
    heights: for sources such as Open City Model whose buildings all stand at 0. ``sunk`` lifts
    everything within ``sunk_m`` of a building's lowest point to that height: for sources such as
    swissBUILDINGS3D whose walls reach below the terrain.

    Args:
        polygons: In metres, not yet in the local frame.
        building_ids: For the findings.
        label: Reference system of the points.
        options: What to do.
        findings: Receives what was done, and buildings outside the terrain.
    """
    points = polygons.points
    if options.base == "as_given" or len(points) == 0:
        return
    building = np.repeat(polygons.building, np.diff(polygons.ring_starts[polygons.polygon_starts]))
    count = len(building_ids)
    if options.base == "sunk":
        lowest = np.full(count, np.inf)
        np.minimum.at(lowest, building, points[:, 2])
        points[:, 2] = np.maximum(points[:, 2], lowest[building] + options.sunk_m)
        detail = f"walls cut {options.sunk_m:g} m above their lowest point"
    else:
        heights = np.full(count, options.ground_m)
        if options.terrain is not None and label is not None:
            from lodbench.citymodel.surface.ground import ground_under

            sizes = np.maximum(np.bincount(building, minlength=count), 1)
            middles = np.stack(
                [np.bincount(building, points[:, k], minlength=count) / sizes for k in (0, 1)], axis=1
            )
            ground = ground_under(middles, label, options)
            for b in np.flatnonzero(~np.isfinite(ground)):
                findings.add(GROUND_DEFAULTED, building_ids[b], f"ground_m={options.ground_m:g}")
            heights = np.where(np.isfinite(ground), ground, options.ground_m)
        points[:, 2] += heights[building]
        detail = f"set on {options.terrain or f'{options.ground_m:g} m'}"
    findings.add(BASE_MOVED, "", detail)


# So many buildings are enough to decide.
_SAMPLE_BUILDINGS = 4096

# A wall covers less of the square around it in plan. Roofs and footprints are drawn this way and that.
_WALL_SHARE = 0.1

# Of walls that all look outside each adds to the area of the plan; of walls drawn at random they cancel out.
_LEAST_SHARE = 0.5

# So many of the buildings with a result must agree.
_LEAST_AGREEING = 0.9


def faces_tell_north_first(polygons: Polygons, least_buildings: int = 1) -> bool | None:
    """Returns whether northings stand first: exchanged columns mirror houses, whose walls then look inside.

    Args:
        polygons: In the coordinates of the file.
        least_buildings: So many must have a result.

    Returns:
        None where walls do not decide: footprints have none, some publishers draw them at random.
    """
    step = 1 + int(polygons.building.max(initial=0)) // _SAMPLE_BUILDINGS
    chosen = select_polygons(polygons, np.flatnonzero(polygons.building % step == 0))
    if len(chosen) == 0:
        return None
    vectors, _ = newell(chosen)
    first = chosen.ring_starts[chosen.polygon_starts[:-1]]
    plan = chosen.points[:, :2]
    sides = np.maximum.reduceat(plan, first) - np.minimum.reduceat(plan, first)
    is_wall = np.abs(vectors[:, 2]) < _WALL_SHARE * (sides**2).sum(axis=1)
    _, building = np.unique(chosen.building, return_inverse=True)
    counts = np.bincount(building)
    middles = np.stack([np.bincount(building, plan[first, k]) / counts for k in (0, 1)], axis=1)
    areas = is_wall * ((plan[first] - middles[building]) * vectors[:, :2]).sum(axis=1)
    total, largest = np.bincount(building, areas), np.bincount(building, np.abs(areas))
    is_outside, is_inside = total > _LEAST_SHARE * largest, total < -_LEAST_SHARE * largest
    if is_inside.sum() + is_outside.sum() < least_buildings:
        return None
    share = is_inside.sum() / max(is_inside.sum() + is_outside.sum(), 1)
    if share >= _LEAST_AGREEING:
        return True
    return False if is_outside.any() and share <= 1.0 - _LEAST_AGREEING else None
