"""Solids that leak, touch themselves or are turned: each made from a sound box, each with its code."""

import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from lodbench.citymodel import ReadOptions, read_city_model
from lodbench.citymodel.checks import check_city
from lodbench.cli import main

from .gml_text import (
    Ring,
    bounded_by,
    box_rings,
    city,
    link,
    member,
    multi_surface,
    polygon,
    solid,
    surface_members,
    write,
)

BOX = box_rings()


def defects(tmp_path: Path, text: str) -> dict[str, list[str]]:
    """Returns the details of the findings of a check by code."""
    options = ReadOptions(is_strict=False, has_details=True)
    report = check_city(read_city_model(write(tmp_path / "a.gml", text), options=options))
    return {row.code.code: [item.detail for item in row.items] for row in report.rows}


def of_solid(tmp_path: Path, rings: Sequence[Ring]) -> dict[str, list[str]]:
    return defects(tmp_path, city(member(solid(surface_members(map(polygon, rings)), 2))))


def test_a_box_is_sound(tmp_path: Path) -> None:
    assert of_solid(tmp_path, BOX) == {}


def test_a_face_is_missing(tmp_path: Path) -> None:
    assert of_solid(tmp_path, BOX[:5]) == {"LB602": ["edges with one face only: 4"]}


def test_too_few_faces(tmp_path: Path) -> None:
    found = of_solid(tmp_path, BOX[:2])
    assert found["LB601"] == ["faces: 2"]


def test_a_face_is_turned(tmp_path: Path) -> None:
    found = of_solid(tmp_path, [*BOX[:5], BOX[5][::-1]])
    assert found == {"LB606": ["edges that both faces run along the same way: 4"]}


def test_inside_out(tmp_path: Path) -> None:
    assert of_solid(tmp_path, [ring[::-1] for ring in BOX]) == {"LB607": ["encloses -600.000 m3"]}


def test_boxes_that_share_an_edge(tmp_path: Path) -> None:
    other = box_rings(x=500010.0, y=5600010.0)
    assert of_solid(tmp_path, [*BOX, *other]) == {"LB603": ["edges with three faces or more: 1"]}


def test_boxes_that_share_a_corner(tmp_path: Path) -> None:
    other = box_rings(x=500010.0, y=5600010.0, z=56.0)
    found = of_solid(tmp_path, [*BOX, *other])
    assert found["LB604"] == ["vertices where fans of faces touch: 1"]
    assert found["LB605"] == ["pieces: 2"]


def test_boxes_apart(tmp_path: Path) -> None:
    assert of_solid(tmp_path, [*BOX, *box_rings(x=500020.0)]) == {"LB605": ["pieces: 2"]}


def test_borrowed_faces_close_a_solid(tmp_path: Path) -> None:
    walls = "".join(
        bounded_by("WallSurface", multi_surface(surface_members([polygon(ring, gml_id=f"w{n}")])))
        for n, ring in enumerate(BOX)
    )
    links = "".join(link(f"#w{n}") for n in range(6))
    assert defects(tmp_path, city(member(solid(links, 2) + walls))) == {}
    turned = '<gml:surfaceMember><gml:OrientableSurface orientation="-"><gml:baseSurface xlink:href="#w5"/>'
    turned += "</gml:OrientableSurface></gml:surfaceMember>"
    links = "".join(link(f"#w{n}") for n in range(5)) + turned
    assert set(defects(tmp_path, city(member(solid(links, 2) + walls)))) == {"LB606"}


def test_points_within_a_millimetre_are_one(tmp_path: Path) -> None:
    moved = [(x + 0.0002, y, z) for x, y, z in BOX[0]]
    assert of_solid(tmp_path, [moved, *BOX[1:]]) == {}


@pytest.mark.parametrize(("shift", "is_met"), [(5.0, True), (10.0, False)])
def test_parts_that_overlap(tmp_path: Path, shift: float, is_met: bool) -> None:
    boxes = [BOX, box_rings(x=500000.0 + shift, height=9.0)]
    parts = "".join(
        f'<bldg:consistsOfBuildingPart><bldg:BuildingPart gml:id="p{n}">'
        f"{solid(surface_members(map(polygon, box)), 2)}</bldg:BuildingPart></bldg:consistsOfBuildingPart>"
        for n, box in enumerate(boxes)
    )
    found = defects(tmp_path, city(member(parts)))
    assert found == ({"LB608": ["LoD2: p0 and p1, 50.00 m2 over 6.00 m"]} if is_met else {})


def test_places_for_machines_and_for_maps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bent = [(*point[:2], point[2] + (0.5 if k == 0 else 0.0)) for k, point in enumerate(BOX[1])]
    faces = surface_members([polygon(bent, gml_id="roof"), *map(polygon, (*BOX[:1], *BOX[2:]))])
    path = write(tmp_path / "a.gml", city(member(solid(faces, 2))))
    target = tmp_path / "f.geojson"
    assert main(["city", "check", str(path), "--json", "--geojson", str(target)]) == 0
    report = json.loads(capsys.readouterr().out)
    (planar,) = [row for row in report["findings"] if row["code"] == "LB105"]
    assert planar["val3dity"] == "203"
    assert planar["items"][0]["polygon"] == "roof"
    assert planar["items"][0]["place"] == [*bent[0][:2], 56.5]
    assert {"seconds", "read_seconds"} <= report.keys()
    features = json.loads(target.read_text())["features"]
    (point,) = [f for f in features if f["properties"]["code"] == "LB105"]
    assert point["geometry"]["coordinates"][:2] == pytest.approx([9.0, 50.5], abs=0.2)
    assert point["properties"]["building"] == "b1"
