"""Every CityGML and CityJSON sample file: counts as catalogued, areas against an independent sum."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, mesh_city, mesh_model, read_city_model
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.triangulate import triangulate
from lodbench.findings import Findings

_CATALOGUE = Path(__file__).resolve().parents[3] / "shared" / "data" / "README.md"


@dataclass(frozen=True)
class Row:
    """One line of the table of sample files."""

    path: str
    buildings: int
    parts: int
    polygons: int
    duplicates: int


def _rows(kinds: tuple[str, ...]) -> list[Row]:
    if not _CATALOGUE.is_file():
        return []
    rows = []
    for line in _CATALOGUE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("| ").split(" | ")]
        if len(cells) < 9 or not cells[2].startswith(kinds) or "/" not in cells[3]:
            continue
        buildings, parts = (int(text) for text in cells[3].split(" / "))
        rows.append(Row(cells[0], buildings, parts, int(cells[4]), int(cells[8].split("/")[2])))
    return rows


FILES = [row for row in _rows(("CityGML", "CityJSON")) if "503100000000296" not in row.path]
# Polygons of the sources that fold over or cross themselves, by eye.
CROSSING = {"ingolstadt_lod3/4018148.xml": 1}


def newell_areas(model: CityModel) -> list[float]:
    """Polygon areas the slow and obvious way: cross products of each ring, holes taken off."""
    polygons = model.polygons
    areas = []
    for n in range(len(polygons)):
        total = 0.0
        for k, ring in enumerate(range(polygons.polygon_starts[n], polygons.polygon_starts[n + 1])):
            points = polygons.points[polygons.ring_starts[ring] : polygons.ring_starts[ring + 1]]
            points = points - points.mean(axis=0)
            vector = np.cross(np.roll(points, 1, axis=0), points).sum(axis=0)
            total += (1 if k == 0 else -1) * 0.5 * float(np.linalg.norm(vector))
        areas.append(max(total, 0.0))
    return areas


@pytest.mark.parametrize("row", FILES, ids=[row.path for row in FILES])
def test_catalogued_counts(shared_data: Path, row: Row) -> None:
    # One sample has buildings demolished from 2021 to 2099.
    options = ReadOptions(date="2020-01-01")
    model = read_city_model(shared_data / "city" / row.path, options=options)
    assert len(model.building_ids) == row.buildings
    assert model.num_parts == row.parts
    assert sum(model.polygons_read) == row.polygons
    counts = model.findings.counts()
    if "jsonl" not in row.path:  # the catalogue counted those without their transform
        assert counts.get("LB102 DUPLICATE_POINTS", 0) == row.duplicates
    assert not any(code.startswith("LB2") for code in counts if code[:5] not in ("LB201", "LB209"))


@pytest.mark.parametrize("row", FILES, ids=[row.path for row in FILES])
def test_area_of_every_polygon(shared_data: Path, row: Row) -> None:
    model = read_city_model(shared_data / "city" / row.path)
    findings = Findings()
    result = triangulate(model.polygons, model.building_ids, findings)
    expected = np.array(newell_areas(model))
    assert np.allclose(result.area_m2, expected, rtol=1e-9, atol=1e-9)
    named = {int(item.detail.split()[1].rstrip(":")) for item in findings.items}
    others = np.setdiff1d(np.arange(len(expected)), np.array(sorted(named), np.int64))
    # Seen along its normal every polygon is covered, bent or not: nothing is lost.
    assert np.all(np.abs(result.covered_m2 - expected)[others] <= 1e-4 * expected[others])
    assert result.lost_m2 <= 1e-6 * expected.sum()
    assert findings.counts().get("LB106 AREA_MISMATCH", 0) == CROSSING.get(row.path, 0)


@pytest.mark.parametrize(
    ("path", "lod", "crs", "triangles"),
    [
        ("plateau/53395404_bldg_6697_op.gml", "1", "EPSG:6677+6695", 12912),
        ("plateau/51311568_bldg_6697_op.gml", "1", "EPSG:6671+6695", 5084),
        ("plateau/64412288_bldg_6697_op.gml", "1", "EPSG:6680+6695", None),
        ("germany_lod2/LoD2_32_280_5657_1_NW.gml", "2", "EPSG:25832+7837", 2676),
        ("germany_lod2/LoD2_576_5950_1_HH_2016.xml", "2", "EPSG:25832+5783", 1314),
        ("germany_lod2/berlin_open_data_sample_data.citygml", "2", "EPSG:25833", 4879),
        ("ingolstadt_lod3/4018148.xml", "3", "EPSG:32632", None),
        ("switzerland/zurich-lod2-citygml1.xml", "2", "EPSG:21781+5728", None),
        ("netherlands_other/delft-citygml2.xml", "1", "EPSG:7415", None),
    ],
)
def test_default_level_and_reference_system(
    shared_data: Path, path: str, lod: str, crs: str, triangles: int | None
) -> None:
    scene = mesh_city(read_city_model(shared_data / "city" / path))
    assert (scene.lod, scene.crs) == (lod, crs)
    assert triangles is None or len(scene.triangles) == triangles
    low, high = scene.extent_m
    assert low[:2].min() >= 0
    assert (high - low)[:2].max() < 1000


def test_plateau_lies_in_nishitokyo(shared_data: Path) -> None:
    from pyproj import Transformer

    model = read_city_model(shared_data / "city/plateau/53395404_bldg_6697_op.gml")
    east, north = (model.polygons.points + model.origin)[0, :2]
    to_degrees = Transformer.from_crs("EPSG:6677", "EPSG:6668", always_xy=True)
    assert to_degrees.transform(east, north) == pytest.approx((139.55424111, 35.75599828), abs=1e-7)


def test_bent_polygons_are_named_with_both_areas(shared_data: Path) -> None:
    mesh = mesh_model(read_city_model(shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml"))
    bent = [item for item in mesh.findings.items if item.code.code == "LB105"]
    assert len(bent) == 25
    assert all("triangles" in item.detail and item.object_id.startswith("DENW") for item in bent)
