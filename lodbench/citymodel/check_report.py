"""The report of a check in words, and as points for a GIS."""

from __future__ import annotations

from typing import Any

import numpy as np

from lodbench.citymodel.check import CityReport, FindingRow
from lodbench.citymodel.codes import VAL3DITY
from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.source import OWN_GEOJSON
from lodbench.errors import CityModelError


def findings_geojson(report: CityReport) -> dict[str, Any]:
    """Returns the findings that have a place as a GeoJSON of points, longitude and latitude in WGS 84.

    Raises:
        CityModelError: The city has no reference system, so that nobody knows where it lies.
    """
    if report.crs is None:
        raise CityModelError(
            f"{report.source} names no reference system, which a GeoJSON needs.", "Name it: crs=EPSG:25832."
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
        >>> from lodbench.citymodel.check import LevelAreas
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
