"""The findings of a city as a report: one row per kind of defect, and where every square metre went."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lodbench.citymodel.mesh import mesh_model
from lodbench.citymodel.model import CityModel
from lodbench.errors import CityModelError
from lodbench.findings import Finding, FindingCode, Severity

_ORDER = {Severity.ERROR: 0, Severity.WARNING: 1, Severity.INFO: 2}


@dataclass(frozen=True, slots=True)
class FindingRow:
    """All findings of one kind.

    Attributes:
        code: The kind.
        count: How often it was met, over all levels of detail.
        objects: Ids of the buildings it was met in, each once, in order.
        example: Detail of the first that has one.
    """

    code: FindingCode
    count: int
    objects: tuple[str, ...]
    example: str


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
    """

    source: str
    rows: tuple[FindingRow, ...]
    areas: tuple[LevelAreas, ...]

    @property
    def has_errors(self) -> bool:
        """Tells whether anything was lost: then `city check` exits with 1."""
        return any(row.code.severity is Severity.ERROR for row in self.rows)

    def to_json(self) -> dict[str, Any]:
        """Returns plain values, with every building of every finding."""
        return {
            "source": self.source,
            "findings": [
                {
                    "code": row.code.code,
                    "name": row.code.name,
                    "severity": row.code.severity.value,
                    "meaning": row.code.meaning,
                    "count": row.count,
                    "objects": list(row.objects),
                    "example": row.example,
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
    """Returns every finding of reading and of meshing each level of detail.

    Read the model with ``ReadOptions(is_strict=False)``, so that a bad coordinate is a finding like
    any other and does not end the check.

    Args:
        model: The city as read.
    """
    findings = list(model.findings.items)
    areas = []
    for lod in model.lods:
        try:
            mesh = mesh_model(model, lod)
        except CityModelError:
            areas.append(LevelAreas(lod, 0.0, 0.0, 0.0))  # the findings of reading say why
            continue
        findings += mesh.findings.items
        areas.append(LevelAreas(lod, mesh.area_m2, mesh.meshed_m2, mesh.lost_m2))
    return CityReport(model.source, _rows(findings), tuple(areas))


def _rows(findings: list[Finding]) -> tuple[FindingRow, ...]:
    by_code: dict[FindingCode, list[Finding]] = {}
    for finding in findings:
        by_code.setdefault(finding.code, []).append(finding)
    rows = [
        FindingRow(
            code=code,
            count=len(items),
            objects=tuple(dict.fromkeys(item.object_id for item in items if item.object_id)),
            example=next((item.detail for item in items if item.detail), ""),
        )
        for code, items in by_code.items()
    ]
    return tuple(sorted(rows, key=lambda row: (_ORDER[row.code.severity], row.code.code)))


def format_report(report: CityReport) -> str:
    """Returns a report as lines of text: a table of findings, then the areas.

    Example:
        >>> print(format_report(CityReport("a.gml", (), (LevelAreas("1", 10.0, 10.0, 0.0),))))
        a.gml
        no findings
        LoD1: 10.00 m2 in, 10.00 m2 meshed, 0.00 m2 lost
    """
    lines = [report.source]
    cells = [("code", "name", "severity", "count", "buildings", "what it means")]
    for row in report.rows:
        kind = row.code
        cells.append(
            (kind.code, kind.name, kind.severity.value, str(row.count), str(len(row.objects)), kind.meaning)
        )
    if len(cells) == 1:
        lines.append("no findings")
    else:
        widths = [max(len(line[i]) for line in cells) for i in range(5)]
        rows: tuple[FindingRow | None, ...] = (None, *report.rows)
        for line, found in zip(cells, rows, strict=True):
            text = "  ".join(
                cell.rjust(width) if i in (3, 4) else cell.ljust(width)
                for i, (cell, width) in enumerate(zip(line, widths, strict=False))
            )
            lines.append(f"{text}  {line[5]}")
            if found is not None and (found.objects or found.example):
                first = ", ".join(filter(None, (*found.objects[:1], found.example)))
                lines.append(f"{'':{widths[0]}}  e.g. {first}")
    for level in report.areas:
        name = f"LoD{level.lod}" if level.lod else "all"
        areas = (level.area_in_m2, level.meshed_m2, level.lost_m2)
        lines.append("{}: {:.2f} m2 in, {:.2f} m2 meshed, {:.2f} m2 lost".format(name, *areas))
    return "\n".join(lines)
