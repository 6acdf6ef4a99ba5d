"""Is a city sound: its polygons in their planes, its shells, its solids; and the report of all findings."""

from __future__ import annotations

import re
import time
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel import codes
from lodbench.citymodel.checks.shells import check_shells
from lodbench.citymodel.checks.solids import check_solids
from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.derive import part_blocks
from lodbench.citymodel.model import CityModel, Polygons, SurfaceKind, select_polygons
from lodbench.citymodel.read import NothingToMesh, mesh_model
from lodbench.citymodel.source import OWN_GEOJSON
from lodbench.citymodel.triangulate import (
    CHUNK_POLYGONS,
    MAX_CORNERS,
    PLANAR_TOLERANCE_M,
    newell,
    triangulate,
)
from lodbench.errors import CityModelError
from lodbench.findings import Finding, FindingCode, Findings, Severity

# What GEOS says is wrong, by the beginning of its reason.
_REASONS: tuple[tuple[str, FindingCode], ...] = (
    ("Ring Self-intersection", codes.RING_SELF_CONTACT),
    ("Self-intersection", codes.RINGS_INTERSECT),
    ("Hole lies outside", codes.HOLE_OUTSIDE),
    ("Nested holes", codes.HOLES_NESTED),
    ("Holes are nested", codes.HOLES_NESTED),
    ("Interior is disconnected", codes.INTERIOR_SPLIT),
    ("Duplicate Rings", codes.RINGS_EQUAL),
)

_PLACE = re.compile(r"\[(\S+) (\S+)\]")

_MAX_TURN_DEG = 20.0  # as val3dity has it

_MIN_OVERLAP_M2, _MIN_OVERLAP_M = 0.1, 0.1


class _Flattened(NamedTuple):
    """P polygons of R rings laid into their planes."""

    areas: NDArray[np.float64]  # (P,) square metres
    anchors: NDArray[np.float64]  # (P, 3) where planes have their origins, metres
    frames: NDArray[np.float64]  # (P, 3, 2) their axes
    rings: NDArray[Any]  # (R,) as shapely has them
    shapes: NDArray[Any]  # (P,) likewise polygons
    ring_polygon: NDArray[np.int64]  # (R,) the polygon of each ring


def check_planes(model: CityModel, findings: Findings) -> None:
    """Adds what is wrong with polygons viewed along their normals, each with its number and place.

    Args:
        model: The city.
        findings: Receives one finding of a kind per polygon.
    """
    import shapely

    is_outer = model.polygons.kind != SurfaceKind.INTERIOR
    # Larger ones are reported as not cut; crossings of a million edges would take hours.
    corners = np.diff(model.polygons.ring_starts[model.polygons.polygon_starts])
    outer = np.flatnonzero(is_outer & (corners <= MAX_CORNERS))
    polygons = select_polygons(model.polygons, outer)
    if len(polygons) == 0:
        return
    areas, anchors, frames, rings, shapes, ring_polygon = _flattened(polygons)
    has_area = areas > 1e-6

    def add(code: FindingCode, n: int, detail: str, spot: NDArray[np.float64]) -> None:
        place = anchors[n] + frames[n] @ spot + model.origin
        building = model.building_ids[polygons.building[n]]
        findings.add(code, building, detail, polygon=int(outer[n]), place=tuple(place.tolist()))

    for n in np.flatnonzero(~shapely.is_valid(shapes) & has_area).tolist():
        reason = str(shapely.is_valid_reason(shapes[n]))
        match = _PLACE.search(reason)
        spot = np.zeros(2) if match is None else np.array([float(match[1]), float(match[2])])
        code = _code_of(reason, rings[polygons.polygon_starts[n] : polygons.polygon_starts[n + 1]])
        add(code, n, reason.partition("[")[0].strip().lower(), spot)
    is_hole = np.ones(len(rings), np.bool_)
    is_hole[polygons.polygon_starts[:-1]] = False
    is_turned = is_hole & shapely.is_ccw(rings) & has_area[ring_polygon]
    for n in np.unique(ring_polygon[is_turned]).tolist():
        add(codes.HOLE_TURNED, n, "a hole runs the way of its outline", np.zeros(2))


def _flattened(polygons: Polygons) -> _Flattened:
    """Returns polygons laid into their own planes."""
    import shapely

    vectors, areas = newell(polygons)
    unit = vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)[:, None]
    helper = np.eye(3)[np.argmin(np.abs(unit), axis=1)]
    across = np.cross(helper, unit)
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-300)[:, None]
    frames = np.stack([across, np.cross(unit, across)], axis=2)
    anchors = polygons.points[polygons.ring_starts[polygons.polygon_starts[:-1]]]
    owner = np.repeat(np.arange(len(polygons)), np.diff(polygons.ring_starts[polygons.polygon_starts]))
    plane = np.einsum("pi,pij->pj", polygons.points - anchors[owner], frames[owner])
    lengths = np.diff(polygons.ring_starts)
    closed = np.insert(plane, np.cumsum(lengths), plane[polygons.ring_starts[:-1]], axis=0)
    rings = shapely.linearrings(closed, indices=np.repeat(np.arange(len(lengths)), lengths + 1))
    ring_polygon = np.repeat(np.arange(len(polygons)), np.diff(polygons.polygon_starts))
    return _Flattened(
        areas, anchors, frames, rings, shapely.polygons(rings, indices=ring_polygon), ring_polygon
    )


def _code_of(reason: str, rings: NDArray[Any]) -> FindingCode:
    """Returns the finding for the reason why a polygon of these rings is not valid."""
    import shapely

    code = next((code for start, code in _REASONS if reason.startswith(start)), codes.RING_SELF_CONTACT)
    if code is not codes.RINGS_INTERSECT:
        return code
    if not shapely.is_simple(rings).all():
        return codes.RING_SELF_CONTACT
    are_equal = any(shapely.equals(ring, rings[k + 1 :]).any() for k, ring in enumerate(rings))
    return codes.RINGS_EQUAL if are_equal else code


def check_folds(model: CityModel, findings: Findings) -> None:
    """Adds polygons with a piece turned from their plane although no corner is a centimetre off it."""
    outer = np.flatnonzero(model.polygons.kind != SurfaceKind.INTERIOR)
    for first in range(0, len(outer), CHUNK_POLYGONS):
        own = outer[first : first + CHUNK_POLYGONS]
        polygons = select_polygons(model.polygons, own)
        result = triangulate(polygons, model.building_ids, Findings())
        corners = polygons.points[result.triangles]
        vectors = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        sizes = np.linalg.norm(vectors, axis=1)
        normals, _ = newell(polygons)
        unit = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
        along = np.einsum("ij,ij->i", vectors, unit[result.polygon])
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        # What is narrower than corners may be off their plane has no direction worth the name.
        is_wide = 2.0 * sizes > PLANAR_TOLERANCE_M * longest
        is_folded = (np.abs(along) < np.cos(np.radians(_MAX_TURN_DEG)) * sizes) & is_wide
        is_folded &= result.deviation_m[result.polygon] <= PLANAR_TOLERANCE_M
        at, where = np.unique(result.polygon[is_folded], return_index=True)
        spots = corners[is_folded][where].mean(axis=1) + model.origin
        for n, spot in zip(at.tolist(), spots.tolist(), strict=True):
            building = model.building_ids[polygons.building[n]]
            findings.add(codes.FOLDED, building, "a fold", polygon=int(own[n]), place=tuple(spot))


def check_parts(model: CityModel, findings: Findings) -> None:
    """Adds parts of a building whose insides overlap for certain.

    Viewed from above, between the lowest point of each part and the lowest point of its roof: what overlaps
    there overlaps whatever the shape of the roofs.

    Args:
        model: The city.
        findings: Receives one finding per pair of parts.
    """
    import shapely

    if model.objects is None or model.polygons.part is None:
        return
    for lod in model.lods:
        plans, owner, bottom, top = part_blocks(model, lod)
        if len(owner) < 2:
            continue
        tree = shapely.STRtree(plans)
        first, second = tree.query(plans, predicate="intersects")
        building = model.objects.building[owner]
        is_pair = (owner[first] < owner[second]) & (building[first] == building[second])
        first, second = first[is_pair], second[is_pair]
        shared = shapely.intersection(plans[first], plans[second])
        areas = shapely.area(shared)
        a, b = owner[first], owner[second]
        heights = np.minimum(top[a], top[b]) - np.maximum(bottom[a], bottom[b])
        for n in np.flatnonzero((areas > _MIN_OVERLAP_M2) & (heights > _MIN_OVERLAP_M)).tolist():
            names = model.objects.ids[a[n]], model.objects.ids[b[n]]
            spot = shapely.get_coordinates(shapely.point_on_surface(shared[n]))[0]
            place = np.array([*spot, max(bottom[a[n]], bottom[b[n]])]) + model.origin
            findings.add(
                codes.PARTS_OVERLAP,
                model.building_ids[int(building[first[n]])],
                f"LoD{lod}: {names[0]} and {names[1]}, {areas[n]:.2f} m2 over {heights[n]:.2f} m",
                place=tuple(place.tolist()),
            )


_ORDER = {Severity.ERROR: 0, Severity.WARNING: 1, Severity.INFO: 2}


@dataclass(frozen=True, slots=True)
class FindingRow:
    """All findings of one kind."""

    code: FindingCode  # the kind
    count: int  # how often it was met, over all levels of detail
    objects: tuple[str, ...]  # ids of the buildings it was met in, each once, in order
    example: str  # detail of the first that has one
    items: tuple[FoundDefect, ...] = ()  # all of them


@dataclass(frozen=True, slots=True)
class FoundDefect:
    """One finding, with where it is."""

    building: str  # id of the building, or ""
    detail: str  # in words
    polygon: str  # id of the polygon at fault in the file, its number where it has none, or ""
    place: tuple[float, ...] | None  # a point of it, (x, y, z) in the city's coordinates, or None


@dataclass(frozen=True, slots=True)
class LevelAreas:
    """What became of the area of one level of detail, square metres."""

    lod: str
    area_in_m2: float
    meshed_m2: float
    lost_m2: float


@dataclass(frozen=True, slots=True)
class CityReport:
    """The outcome of a check."""

    source: str  # the file or folder
    rows: tuple[FindingRow, ...]  # errors first, then warnings, then infos, each by code
    areas: tuple[LevelAreas, ...]  # per level of detail
    crs: str | None = None  # reference system of the places, or None
    seconds: float = 0.0  # what the check took

    @property
    def has_errors(self) -> bool:
        """Returns whether anything was lost: then `city check` exits with 1."""
        return any(row.code.severity is Severity.ERROR for row in self.rows)

    def to_json(self) -> dict[str, Any]:
        """Returns plain values, with every building of every finding."""
        return {
            "source": self.source,
            "crs": self.crs,
            "seconds": round(self.seconds, 3),
            "findings": [
                {
                    "code": row.code.code,
                    "name": row.code.name,
                    "severity": row.code.severity.value,
                    "val3dity": codes.VAL3DITY.get(row.code),
                    "meaning": row.code.meaning,
                    "count": row.count,
                    "objects": list(row.objects),
                    "example": row.example,
                    "items": [
                        {
                            "building": item.building,
                            "polygon": item.polygon,
                            "place": None if item.place is None else [round(x, 4) for x in item.place],
                            "detail": item.detail,
                        }
                        for item in row.items
                    ],
                }
                for row in self.rows
            ],
            "areas": [
                {
                    "lod": level.lod,
                    "area_in_m2": round(level.area_in_m2, 3),
                    "meshed_m2": round(level.meshed_m2, 3),
                    "lost_m2": round(level.lost_m2, 3),
                }
                for level in self.areas
            ],
        }


def check_city(model: CityModel) -> CityReport:
    """Returns every finding of reading, of meshing each level of detail, and of the geometry itself.

    Read the model with ``ReadOptions(is_strict=False, has_details=True)``: a bad coordinate is then a finding
    like any other, and solids are there to be looked at.
    """
    start = time.perf_counter()
    defects = [_defect(model, item) for item in model.findings.items]
    areas = []
    for lod in model.lods:
        try:
            mesh = mesh_model(model, lod, stands_in=False)
        except NothingToMesh as nothing:
            areas.append(LevelAreas(lod, nothing.area_m2, 0.0, nothing.area_m2))
            defects += _of_level(model, lod, nothing.findings)
            continue
        defects += _of_level(model, lod, mesh.findings)
        areas.append(LevelAreas(lod, mesh.area_m2, mesh.meshed_m2, mesh.lost_m2))
    geometry = Findings()
    check_planes(model, geometry)
    check_folds(model, geometry)
    check_shells(model, geometry)
    check_solids(model, geometry)
    check_parts(model, geometry)
    defects += [_defect(model, item) for item in geometry.items]
    return CityReport(model.source, _rows(defects), tuple(areas), model.crs, time.perf_counter() - start)


def _of_level(model: CityModel, lod: str, findings: Findings) -> list[tuple[FindingCode, FoundDefect]]:
    """Returns the findings of meshing a level, whose polygons are numbered by building."""
    polygons = model.polygons
    is_meshed = polygons.lod == model.lods.index(lod)
    is_meshed &= (polygons.kind != SurfaceKind.INTERIOR) | model.has_interiors
    chosen = np.flatnonzero(is_meshed)
    order = chosen[np.argsort(polygons.building[chosen], kind="stable")]
    defects = []
    for item in findings.items:
        place = None if item.place is None else tuple((np.asarray(item.place) + model.origin).tolist())
        number = int(order[item.polygon]) if item.polygon >= 0 else -1
        defects.append(_defect(model, replace(item, polygon=number, place=place)))
    return defects


def _defect(model: CityModel, item: Finding) -> tuple[FindingCode, FoundDefect]:
    name = ""
    if item.polygon >= 0:
        name = (model.polygon_ids[item.polygon] if model.polygon_ids else "") or f"polygon {item.polygon}"
    return item.code, FoundDefect(item.object_id, item.detail, name, item.place)


def _rows(defects: list[tuple[FindingCode, FoundDefect]]) -> tuple[FindingRow, ...]:
    by_code: dict[FindingCode, list[FoundDefect]] = {}
    for code, defect in defects:
        by_code.setdefault(code, []).append(defect)
    rows = [
        FindingRow(
            code=code,
            count=len(items),
            objects=tuple(dict.fromkeys(item.building for item in items if item.building)),
            example=next((item.detail for item in items if item.detail), ""),
            items=tuple(items),
        )
        for code, items in by_code.items()
    ]
    return tuple(sorted(rows, key=lambda row: (_ORDER[row.code.severity], row.code.code)))


def findings_geojson(report: CityReport) -> dict[str, Any]:
    """Returns the findings that have a place as a GeoJSON of points, longitude and latitude in WGS 84.

    Raises:
        CityModelError: The city has no reference system, so that nobody knows where it lies.
    """
    if report.crs is None:
        raise CityModelError(
            f"{report.source} names no reference system, which a GeoJSON needs.", "Name it: `crs=EPSG:25832`."
        )
    from pyproj import Transformer

    placed = [(row.code, item) for row in report.rows for item in row.items if item.place is not None]
    points = np.asarray([item.place for _, item in placed], np.float64).reshape(-1, 3)
    to_degrees = Transformer.from_crs(require_crs(report.crs).horizontal, "EPSG:4326", always_xy=True)
    longitudes, latitudes = to_degrees.transform(points[:, 0], points[:, 1])
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [round(x, 8), round(y, 8), round(z, 3)]},
            "properties": {
                "code": code.code,
                "name": code.name,
                "severity": code.severity.value,
                "val3dity": codes.VAL3DITY.get(code),
                "building": item.building,
                "polygon": item.polygon,
                "detail": item.detail,
            },
        }
        for (code, item), x, y, z in zip(
            placed, longitudes.tolist(), latitudes.tolist(), points[:, 2].tolist(), strict=True
        )
    ]
    return {**OWN_GEOJSON, "features": features}


def format_report(report: CityReport) -> str:
    """Returns a report as lines of text: a table of findings, then the areas.

    Example:
        >>> from lodbench.citymodel.checks.report import LevelAreas
        >>> print(format_report(CityReport("a.gml", (), (LevelAreas("1", 10.0, 10.0, 0.0),))))
        a.gml
        no findings
        LoD1: 10.00 m2 in, 10.00 m2 meshed, 0.00 m2 lost
    """
    lines = [report.source]
    cells = [("code", "name", "severity", "count", "buildings", "val3dity", "what it means")]
    for row in report.rows:
        kind = row.code
        cells.append(
            (
                *(kind.code, kind.name, kind.severity.value, str(row.count), str(len(row.objects))),
                *(codes.VAL3DITY.get(kind, ""), kind.meaning),
            )
        )
    if len(cells) == 1:
        lines.append("no findings")
    else:
        widths = [max(len(line[i]) for line in cells) for i in range(6)]
        rows: tuple[FindingRow | None, ...] = (None, *report.rows)
        for line, finding in zip(cells, rows, strict=True):
            text = "  ".join(
                cell.rjust(width) if i in (3, 4, 5) else cell.ljust(width)
                for i, (cell, width) in enumerate(zip(line, widths, strict=False))
            )
            lines.append(f"{text}  {line[6]}")
            if finding is not None and (finding.objects or finding.example):
                first = ", ".join(filter(None, (*finding.objects[:1], finding.example)))
                lines.append(f"{'':{widths[0]}}  e.g. {first}")
    for level in report.areas:
        name = f"LoD{level.lod}" if level.lod else "all"
        areas = (level.area_in_m2, level.meshed_m2, level.lost_m2)
        lines.append("{}: {:.2f} m2 in, {:.2f} m2 meshed, {:.2f} m2 lost".format(name, *areas))
    return "\n".join(lines)


def city_info(model: CityModel) -> dict[str, Any]:
    """Returns a summary made of plain values, ready for JSON.

    Returns:
        ``format, version, crs, center_lat_lon`` (degrees, or None without a reference system),
        ``buildings, parts, objects`` (of opted-in layers, type to count), ``pitched_roofs`` (buildings that
        the source states to have one), ``extent_m`` (x, y, z lengths), ``lods``: level name to
        ``polygons`` (as in the file), ``triangles``, ``area_m2`` (of the polygons), ``meshed_m2`` and
        ``lost_m2``; and ``findings``: code and name to count, meshing included; ``finding_objects``: to
        how many buildings they were met in.
    """
    points = model.polygons.points
    types = Counter(
        "Building" if own else name for name, own in zip(model.types(), model.is_building(), strict=True)
    )
    extent = np.ptp(points, axis=0) if len(points) else np.zeros(3)
    findings = Findings(list(model.findings.items))
    lods: dict[str, dict[str, float]] = {}
    for name, num_read in zip(model.lods, model.polygons_read, strict=True):
        row: dict[str, float] = {"polygons": num_read, "triangles": 0, "area_m2": 0.0}
        try:
            mesh = mesh_model(model, name, stands_in=False)
        except NothingToMesh as nothing:
            findings.items += nothing.findings.items
            row["lost_m2"] = row["area_m2"] = round(nothing.area_m2, 3)
        else:
            findings.items += mesh.findings.items
            row["triangles"] = len(mesh.scene.triangles)
            row["area_m2"] = round(mesh.area_m2, 3)
            row["meshed_m2"] = round(mesh.meshed_m2, 3)
            row["lost_m2"] = round(mesh.lost_m2, 3)
        lods[name] = row
    return {
        "format": model.format,
        "version": model.version,
        "crs": model.crs,
        "center_lat_lon": _center_lat_lon(model),
        "buildings": types["Building"],
        "parts": model.num_parts,
        "objects": {name: count for name, count in sorted(types.items()) if name != "Building"},
        "pitched_roofs": 0 if model.pitched is None else int(model.pitched.sum()),
        "extent_m": [round(float(length), 3) for length in extent],
        "lods": lods,
        "findings": findings.counts(),
        "finding_objects": findings.objects(),
    }


def _center_lat_lon(model: CityModel) -> list[float] | None:
    """Returns where on Earth the middle of the city is, to a decimetre: the quickest test of a place."""
    points = model.polygons.points
    if model.crs is None or len(points) == 0:
        return None
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    x, y = 0.5 * (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) + model.origin[:2]
    try:
        lon, lat = Transformer.from_crs(model.crs, "EPSG:4326", always_xy=True).transform(x, y)
    except ProjError:
        return None
    return [round(lat, 6), round(lon, 6)] if np.isfinite([lat, lon]).all() else None
