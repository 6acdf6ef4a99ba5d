"""Is a city sound: its polygons in their planes, its shells, its solids; and the report of all findings."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lodbench.citymodel.checks.planes import check_folds, check_parts, check_planes
from lodbench.citymodel.checks.shells import check_shells
from lodbench.citymodel.checks.solids import check_solids
from lodbench.citymodel.codes import VAL3DITY
from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.model import (
    CityModel,
    SurfaceKind,
)
from lodbench.citymodel.read import NothingToMesh, mesh_model
from lodbench.citymodel.source import OWN_GEOJSON
from lodbench.errors import CityModelError
from lodbench.findings import Finding, FindingCode, Findings, Severity

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
                    "val3dity": VAL3DITY.get(row.code),
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
    found = [_defect(model, item) for item in model.findings.items]
    areas = []
    for lod in model.lods:
        try:
            mesh = mesh_model(model, lod, stands_in=False)
        except NothingToMesh as nothing:
            areas.append(LevelAreas(lod, nothing.area_m2, 0.0, nothing.area_m2))
            found += _of_level(model, lod, nothing.findings)
            continue
        found += _of_level(model, lod, mesh.findings)
        areas.append(LevelAreas(lod, mesh.area_m2, mesh.meshed_m2, mesh.lost_m2))
    geometry = Findings()
    check_planes(model, geometry)
    check_folds(model, geometry)
    check_shells(model, geometry)
    check_solids(model, geometry)
    check_parts(model, geometry)
    found += [_defect(model, item) for item in geometry.items]
    return CityReport(model.source, _rows(found), tuple(areas), model.crs, time.perf_counter() - start)


def _of_level(model: CityModel, lod: str, findings: Findings) -> list[tuple[FindingCode, FoundDefect]]:
    """Returns the findings of meshing a level, whose polygons are numbered by building."""
    polygons = model.polygons
    is_meshed = polygons.lod == model.lods.index(lod)
    is_meshed &= (polygons.kind != SurfaceKind.INTERIOR) | model.has_interiors
    chosen = np.flatnonzero(is_meshed)
    order = chosen[np.argsort(polygons.building[chosen], kind="stable")]
    found = []
    for item in findings.items:
        place = None if item.place is None else tuple((np.asarray(item.place) + model.origin).tolist())
        number = int(order[item.polygon]) if item.polygon >= 0 else -1
        found.append(_defect(model, replace(item, polygon=number, place=place)))
    return found


def _defect(model: CityModel, item: Finding) -> tuple[FindingCode, FoundDefect]:
    name = ""
    if item.polygon >= 0:
        name = (model.polygon_ids[item.polygon] if model.polygon_ids else "") or f"polygon {item.polygon}"
    return item.code, FoundDefect(item.object_id, item.detail, name, item.place)


def _rows(found: list[tuple[FindingCode, FoundDefect]]) -> tuple[FindingRow, ...]:
    by_code: dict[FindingCode, list[FoundDefect]] = {}
    for code, defect in found:
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
                "val3dity": VAL3DITY.get(code),
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
                *(VAL3DITY.get(kind, ""), kind.meaning),
            )
        )
    if len(cells) == 1:
        lines.append("no findings")
    else:
        widths = [max(len(line[i]) for line in cells) for i in range(6)]
        rows: tuple[FindingRow | None, ...] = (None, *report.rows)
        for line, found in zip(cells, rows, strict=True):
            text = "  ".join(
                cell.rjust(width) if i in (3, 4, 5) else cell.ljust(width)
                for i, (cell, width) in enumerate(zip(line, widths, strict=False))
            )
            lines.append(f"{text}  {line[6]}")
            if found is not None and (found.objects or found.example):
                first = ", ".join(filter(None, (*found.objects[:1], found.example)))
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
