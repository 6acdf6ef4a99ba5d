"""Footprints with heights: GeoPackage, Shapefile, GeoJSON, FlatGeobuf, FileGDB, GeoParquet to LoD1 blocks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel import codes
from lodbench.citymodel.attributes import pitched_buildings
from lodbench.citymodel.crs import resolve_crs
from lodbench.citymodel.extrude import clean_rings, extrude, shaped_building
from lodbench.citymodel.model import (
    HIGHEST_M,
    LOWEST_M,
    TALLEST_M,
    CityObjects,
    SurfaceKind,
    starts_of,
    take_segments,
)
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.raw import NotACity, RawCity, city_of_columns
from lodbench.citymodel.surface.ground import MeasuredFootprints, ground_under, measure_footprints
from lodbench.citymodel.vector.columns import Columns, read_table
from lodbench.citymodel.vector.gdal import WkbPolygons, missing_bytes
from lodbench.errors import CityModelError
from lodbench.findings import Findings


def surfaces_as_read(polygons: WkbPolygons, columns: Columns, source: str, crs: str | None) -> RawCity:
    """Returns polygons with heights as surfaces of level 2, one building per geometry.

    Args:
        polygons: With at least one ring.
        columns: With a row per geometry; those without a polygon are no buildings.
        source: Name of the file.
        crs: Its reference system.
    """
    used, building = np.unique(np.asarray(polygons.owner, np.int64), return_inverse=True)
    ids = columns.ids()
    pitched = pitched_buildings(columns.roof_types(), len(ids))
    surfaces = {
        "points": np.concatenate(polygons.rings),
        "ring_lengths": np.asarray([len(ring) for ring in polygons.rings], np.int64),
        "ring_counts": np.asarray(polygons.ring_counts, np.int64),
        "building": building.reshape(-1),
    }
    return city_of_columns(
        surfaces,
        source=source,
        format="surfaces",
        srs_names=(crs,),
        building_ids=tuple(ids[i] for i in used),
        lods=("2",),
        has_closing_points=True,
        axis_orders=("east_first",),
        pitched=None if pitched is None else pitched[used],
    )


def read_footprints(path: str, source: str, options: ReadOptions) -> RawCity:
    """Returns blocks of level 1 over the footprints of a vector file.

    A file whose polygons stand upright (the MultiPatches of a FileGDB) holds the buildings' surfaces
    themselves; they come back as they are, as level 2. So do slanting ones where nothing states heights:
    with heights they are footprints draped over the ground. Ground heights come from
    ``options.ground_column``, else ``options.terrain``, else a column that looks like one, else
    ``options.ground_m``.

    Args:
        path: What GDAL opens, ``/vsizip/`` paths included.
        source: Name for messages.
        options: Columns, storey height, ground, reference system.

    Raises:
        CityModelError: pyogrio is not installed, the file cannot be read, has no reference system
            or no heights.
        NotACity: It is empty.
    """
    findings = Findings()
    for what in missing_bytes(path):
        if options.is_strict:
            raise CityModelError(f"{source} is cut off: {what}.", "Download or export the file again.")
        findings.add(codes.FILE_CUT_OFF, source, what)
    crs, geometries, table = read_table(path, source, options, findings)
    if options.crs is None and crs is None:
        raise CityModelError(
            f"{source} names no reference system (a Shapefile needs its .prj).", "Name it: `crs=EPSG:4326`."
        )
    if not geometries:
        raise NotACity(f"{source} has no footprints.", "Is it the building tile of the city?")
    polygons = _parse(geometries, source)
    columns = Columns(table, len(geometries), source)
    if polygons.has_z and _are_surfaces(polygons, columns, options):
        city = surfaces_as_read(polygons, columns, source, crs)
    else:
        measured, met = None, Findings()
        if options.surface is not None:
            named = options.crs or str(crs)
            measured = measure_footprints(geometries, columns.ids(), named, options, met)
        city = _blocks(polygons, columns, source, crs, options, measured)
        city.findings.items += met.items
    city.findings.items[:0] = findings.items
    return city


def _are_surfaces(polygons: WkbPolygons, columns: Columns, options: ReadOptions) -> bool:
    if not polygons.has_uneven_rings():
        return False
    return polygons.has_upright_rings() or not columns.has_heights(options)


def _parse(geometries: list[bytes | None], source: str) -> WkbPolygons:
    polygons = WkbPolygons()
    for i, data in enumerate(geometries):
        if data is None:
            continue
        try:
            polygons.add(data, i)
        except ValueError as error:
            raise CityModelError(
                f"{source}: footprint {i + 1} is malformed: {error}.", "Repair or export the file again."
            ) from None
    return polygons


def _blocks(
    polygons: WkbPolygons,
    columns: Columns,
    source: str,
    crs: str | None,
    options: ReadOptions,
    measured: MeasuredFootprints | None,
) -> RawCity:
    """Returns the footprints drawn up from the ground to their heights."""
    findings = Findings()
    ids = columns.ids()
    for kind in sorted(polygons.ignored):
        findings.add(codes.GEOMETRY_UNSUPPORTED, source, f"geometry type {kind} has no area")
    known = resolve_crs(options.crs or str(crs))
    # Columns are in the unit of the heights, feet where the plane is; what the user sets is in metres.
    unit_m = 1.0 if known is None else known.height_unit_m
    heights, bottoms, height_from = _heights(columns, options, unit_m, ids, measured, findings)
    rings, ring_starts, polygon_starts, owner = _kept_polygons(polygons, heights, ids, findings)
    if len(owner) == 0 and any(item.code is codes.UNDERGROUND for item in findings.items):
        raise NotACity(
            f"{source} has no footprint but below the ground.", "Is it the building tile of the city?"
        )
    if len(owner) == 0:
        raise _no_height(source, findings)
    if not np.isfinite(rings).all():
        raise CityModelError(
            f"{source} has coordinates that are not finite numbers.", "Repair or export the file again."
        )
    corners = rings[ring_starts[polygon_starts[:-1]]]
    ground, ground_from = _ground(columns, corners, owner, options.crs or str(crs), options)
    if measured is not None:
        below = measured.ground_m[owner] / unit_m
        ground = np.where(np.isfinite(below), below, ground)
        ground_from = np.where(np.isfinite(below), measured.ground_source, ground_from)
    ground, ground_from = _without_gaps(ground, ground_from, owner, ids, options, unit_m, polygons, findings)
    blocks = extrude(rings, ring_starts, polygon_starts, ground + bottoms[owner], ground + heights[owner])
    used, building = np.unique(owner[blocks.footprint], return_inverse=True)
    pitched = pitched_buildings(columns.roof_types(), len(ids))
    objects = None
    if options.has_details:
        first, parents = np.unique(owner, return_index=True)[1], columns.parents()
        stated = [
            {
                "measuredHeight": round(float(heights[n]) * unit_m, 3),
                "height_from": str(height_from[n]),
                "ground_from": str(ground_from[k]),
            }
            | ({} if measured is None else measured.attributes(n))
            | ({"part_of": parents[n]} if n in parents else {})
            for n, k in zip(used.tolist(), first.tolist(), strict=True)
        ]
        named = tuple(ids[n] for n in used)
        lone = np.full(len(used), -1, np.int32), np.arange(len(used), dtype=np.int32)
        objects = CityObjects(named, ("Building",) * len(used), *lone, tuple(stated))
    city = city_of_columns(
        blocks.columns(building.reshape(-1)),
        source=source,
        format="footprints",
        srs_names=(crs,),
        building_ids=tuple(ids[i] for i in used),
        lods=("1",),
        findings=findings,
        # Vector files keep longitude or easting first whatever their reference system declares.
        axis_orders=("east_first",),
        pitched=None if pitched is None else pitched[used],
        part=None if objects is None else building.reshape(-1).astype(np.int32),
        objects=objects,
    )
    flat, counts = np.unique(owner, return_counts=True)
    is_measured = np.zeros(len(ids), np.bool_) if measured is None else np.isfinite(measured.height_m)
    shaped = {
        int(np.searchsorted(used, n)): stated
        for n, stated in columns.stated_roofs(options, unit_m).items()
        # Of a roof that was measured its middle is known, not its ridge.
        if n in flat[counts == 1] and not is_measured[n]
    }
    is_in_degrees = known is not None and bool(known.horizontal.is_geographic)
    squeeze = float(np.cos(np.radians(np.median(rings[:, 1])))) if is_in_degrees else 1.0
    return _with_roofs(city, shaped, squeeze)


def _with_roofs(city: RawCity, shaped: Mapping[int, tuple[str, float, bool]], squeeze: float) -> RawCity:
    """Returns a city of blocks with level 2 of the buildings whose roofs are stated."""
    wanted = np.flatnonzero((city.kind == SurfaceKind.ROOF) & np.isin(city.building, list(shaped)))
    floors = {int(city.building[n]): n for n in np.flatnonzero(city.kind == SurfaceKind.GROUND).tolist()}
    made, owners = [], []
    for n in wanted.tolist():
        building = int(city.building[n])
        shape, rise, is_across = shaped[building]
        starts = city.ring_starts[city.polygon_starts[n] : city.polygon_starts[n + 1] + 1].tolist()
        rings = [city.points[start:end] for start, end in pairwise(starts)]
        floor = float(city.points[city.ring_starts[city.polygon_starts[floors[building]]], 2])
        top = float(rings[0][0, 2])
        faces = shaped_building(
            [ring[:, :2] for ring in rings], shape, (floor, top - rise, top), is_across, squeeze
        )
        made += faces or []
        owners += [building] * len(faces or [])
    if not made:
        return city
    rings = [ring for face in made for ring in face.rings]
    added = np.asarray(owners, np.int32)
    lengths = [*np.diff(city.ring_starts), *map(len, rings)]
    counts = [*np.diff(city.polygon_starts), *(len(face.rings) for face in made)]
    return replace(
        city,
        lods=("1", "2"),
        points=np.concatenate([city.points, *rings]),
        ring_starts=starts_of(np.asarray(lengths, np.int64)),
        polygon_starts=starts_of(np.asarray(counts, np.int64)),
        building=np.concatenate([city.building, added]),
        lod=np.concatenate([city.lod, np.ones(len(made), np.int16)]),
        kind=np.concatenate([city.kind, np.array([face.kind for face in made], np.uint8)]),
        srs=np.concatenate([city.srs, np.zeros(len(made), np.int16)]),
        part=None if city.part is None else np.concatenate([city.part, added]),
    )


def _ground(
    columns: Columns, corners: NDArray[np.float64], owner: NDArray[np.int64], crs: str, options: ReadOptions
) -> tuple[NDArray[np.float64], NDArray[np.str_]]:
    """Returns the ground height of each polygon, NaN where nothing gives it, and what gives it.

    A column that is named goes before the terrain, which fills its gaps; one whose name is merely known
    is asked only where there is no terrain.
    """
    ground, source = np.full(len(owner), np.nan), "column"
    if options.terrain is None or options.ground_column is not None:
        column = columns.ground(options)
        ground = ground if column is None else column[owner]
    is_column = np.isfinite(ground)
    if options.terrain is not None:
        under = ground_under(corners, crs, options)
        ground = np.where(is_column, ground, under)
    return ground, np.where(is_column, source, "terrain model")


def _without_gaps(
    ground: NDArray[np.float64],
    ground_from: NDArray[np.str_],
    owner: NDArray[np.int64],
    ids: list[str],
    options: ReadOptions,
    unit_m: float,
    polygons: WkbPolygons,
    findings: Findings,
) -> tuple[NDArray[np.float64], NDArray[np.str_]]:
    """Returns ground heights with the default in place of what is not known, and what gives each.

    Findings say where, and of which.
    """
    is_lost = ~((ground * unit_m > LOWEST_M) & (ground * unit_m < HIGHEST_M))
    # One word where nothing could give the ground; else those that fall through its gaps.
    default = f"ground_m={options.ground_m:g}{_of_their_own(polygons) if is_lost.any() else ''}"
    for name in [""] if is_lost.all() else [ids[i] for i in np.unique(owner[is_lost])]:
        findings.add(codes.GROUND_DEFAULTED, name, default)
    return np.where(is_lost, options.ground_m / unit_m, ground), np.where(is_lost, "ground_m", ground_from)


def _of_their_own(polygons: WkbPolygons) -> str:
    """Returns that footprints have heights, which are not asked: some are of the ground, some of eaves."""
    heights = np.concatenate([ring[:, 2] for ring in polygons.rings])
    heights = heights[np.isfinite(heights)]
    if not heights.any():
        return ""
    return f"; the outlines lie at {heights.min():g} to {heights.max():g}, which is not used"


def _heights(
    columns: Columns,
    options: ReadOptions,
    unit_m: float,
    ids: list[str],
    measured: MeasuredFootprints | None,
    findings: Findings,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.str_]]:
    """Returns (N,) heights of roofs and of undersides above the ground, and what gives the former.

    Heights are NaN for footprints to leave out.
    """
    heights, names, height_from = np.full(len(ids), np.nan), list[str](), np.full(len(ids), "nothing")
    if measured is None or columns.has_heights(options):
        heights, names = columns.heights(options, unit_m)
        height_from = columns.height_sources(options)
    if measured is not None:
        is_measured = np.isfinite(measured.height_m)
        heights = np.where(is_measured, measured.height_m / unit_m, heights)
        height_from = np.where(is_measured, "surface model", height_from)
    bottoms, bottom_names = columns.bottoms(options, unit_m)
    is_below = columns.underground()
    is_missing = ~((heights > 0) & (heights * unit_m < TALLEST_M))
    is_turned = ~is_missing & (bottoms >= heights)
    code = codes.HEIGHT_MISSING if options.default_height_m is None else codes.HEIGHT_DEFAULTED
    for i in np.flatnonzero((is_missing | is_turned) & ~is_below):
        named = [*names, *(bottom_names if is_turned[i] else ())]
        findings.add(code, ids[i], columns.written(named, int(i)))
    for i in np.flatnonzero(is_below):
        findings.add(codes.UNDERGROUND, ids[i])
    is_missing |= is_turned
    default = np.nan if options.default_height_m is None else options.default_height_m / unit_m
    roof_heights = np.where(is_below, np.nan, np.where(is_missing, default, heights))
    height_from = np.where(is_missing, "default_height_m", height_from)
    return roof_heights, np.where(bottoms < roof_heights, bottoms, 0.0), height_from


def _no_height(source: str, findings: Findings) -> CityModelError:
    """Returns the error of a file without a usable footprint, with what the first lacks."""
    lost = next((item for item in findings.items if item.code is codes.HEIGHT_MISSING), None)
    if lost is None:
        return CityModelError(f"{source} has no footprint with an area.", "Repair or export the file again.")
    return CityModelError(
        f"{source} has no footprint with a height; of {lost.object_id}, {lost.detail}.",
        "Heights are metres, below 1000: name their column, `height_column=...`, or give "
        "`default_height_m=...`",
    )


def _kept_polygons(
    polygons: WkbPolygons, heights: NDArray[np.float64], ids: list[str], findings: Findings
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Returns points, ring and polygon starts and owners of the polygons that can be extruded."""
    owner = np.asarray(polygons.owner, np.int64)
    for i in np.setdiff1d(np.arange(len(ids)), owner):
        findings.add(codes.GEOMETRY_EMPTY, ids[i])
    points, ring_starts, repeats = clean_rings(polygons.rings)
    ring_counts = np.asarray(polygons.ring_counts, np.int64)
    ring_polygon = np.repeat(np.arange(len(owner)), ring_counts)
    for ring in np.flatnonzero(repeats > 0):
        findings.add(codes.DUPLICATE_POINTS, ids[owner[ring_polygon[ring]]])
    is_short = np.diff(ring_starts) < 3
    for ring in np.flatnonzero(is_short):
        findings.add(codes.RING_TOO_SHORT, ids[owner[ring_polygon[ring]]])
    is_lost = is_short[starts_of(ring_counts)[:-1]] | ~np.isfinite(heights[owner])
    ring_kept = ~is_short & ~is_lost[ring_polygon]
    items, new_starts = take_segments(ring_starts, np.flatnonzero(ring_kept))
    counts = np.bincount(ring_polygon[ring_kept], minlength=len(owner))[~is_lost]
    return points[items], new_starts, starts_of(counts), owner[~is_lost]
