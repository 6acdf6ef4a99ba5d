"""The findings of a city as a report: one row per kind of defect, and where every square metre went."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lodbench.citymodel.codes import VAL3DITY
from lodbench.citymodel.meshing import NothingToMesh, mesh_model
from lodbench.citymodel.model import CityModel, SurfaceKind
from lodbench.citymodel.plane_check import check_folds, check_parts, check_planes
from lodbench.citymodel.shells import check_shells
from lodbench.citymodel.solid_check import check_solids
from lodbench.findings import Finding, FindingCode, Findings, Severity

_ORDER = {Severity.ERROR: 0, Severity.WARNING: 1, Severity.INFO: 2}


@dataclass(frozen=True, slots=True)
class FindingRow:
    """All findings of one kind.

    Attributes:
        code: The kind.
        count: How often it was met, over all levels of detail.
        objects: Ids of the buildings it was met in, each once, in order.
        example: Detail of the first that has one.
        items: All of them.
    """

    code: FindingCode
    count: int
    objects: tuple[str, ...]
    example: str
    items: tuple[FoundDefect, ...] = ()


@dataclass(frozen=True, slots=True)
class FoundDefect:
    """One finding, with where it is.

    Attributes:
        building: Id of the building, or "".
        detail: In words.
        polygon: Id of the polygon at fault in the file, its number where it has none, or "".
        place: A point of it, (x, y, z) in the city's coordinates, or None.
    """

    building: str
    detail: str
    polygon: str
    place: tuple[float, ...] | None


@dataclass(frozen=True, slots=True)
class LevelAreas:
    """What became of the area of one level of detail, square metres."""

    lod: str
    area_in_m2: float
    meshed_m2: float
    lost_m2: float


@dataclass(frozen=True, slots=True)
class CityReport:
    """The outcome of a check.

    Attributes:
        source: The file or folder.
        rows: Errors first, then warnings, then infos, each by code.
        areas: Per level of detail.
        crs: Reference system of the places, or None.
        seconds: What the check took.
    """

    source: str
    rows: tuple[FindingRow, ...]
    areas: tuple[LevelAreas, ...]
    crs: str | None = None
    seconds: float = 0.0

    @property
    def has_errors(self) -> bool:
        """Tells whether anything was lost: then `city check` exits with 1."""
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
