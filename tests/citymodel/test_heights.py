"""Heights in feet: they are metres once read, and every name and file says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import read_city_model
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.subset import reproject
from lodbench.cli import main

from .gml_text import box_rings, city, member, polygon, solid, surface_members, write
from .models import model_of

US_FOOT_M = 1200 / 3937


@pytest.mark.parametrize(
    ("crs", "corner", "label"),
    [
        ("EPSG:26918+6360", (585000.0, 4511000.0, 30.0), "EPSG:26918+5703"),
        ("EPSG:2263+6360", (983000.0, 199000.0, 30.0), "EPSG:26918+5703"),
        ("EPSG:2263+5702", (983000.0, 199000.0, 30.0), "EPSG:26918+7968"),
    ],
)
@pytest.mark.parametrize("suffix", [".gml", ".obj", ".json"])
def test_there_and_back(
    tmp_path: Path, crs: str, corner: tuple[float, float, float], label: str, suffix: str
) -> None:
    shift = np.subtract(corner, box_rings()[0][0])
    faces = [[tuple((shift + point).tolist()) for point in ring] for ring in box_rings()]
    text = city(member(solid(surface_members(polygon(face) for face in faces))), srs=crs)
    model = model_of(tmp_path, text)
    heights = np.unique([p[2] for face in faces for p in face]) * US_FOOT_M
    target = tmp_path / f"back{suffix}"
    convert_city(model, target)
    back = read_city_model(target)
    for each in (model, back):
        z = each.polygons.points[:, 2] + each.origin[2]
        assert np.unique(z.round(3)) == pytest.approx(heights, abs=2e-3)
    assert model.crs == label
    assert back.crs == (label.partition("+")[0] if suffix == ".json" else label)


def test_a_target_in_feet_is_named_by_its_metres(tmp_path: Path) -> None:
    text = city(member(solid(surface_members(polygon(face) for face in box_rings()))), srs="EPSG:25832+7837")
    assert reproject(model_of(tmp_path, text), "EPSG:32632+8228").crs == "EPSG:32632+5703"


def test_heights_in_feet_without_a_name_in_metres_lose_theirs() -> None:
    assert require_crs("EPSG:26918+6130").metric_label == "EPSG:26918"
    assert require_crs("EPSG:25832+7837").metric_label == "EPSG:25832+7837"


def test_heights_that_stay_are_given_no_other_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = city(member(solid(surface_members(polygon(face) for face in box_rings()))), srs="EPSG:25832+7837")
    source, target = write(tmp_path / "a.gml", text), tmp_path / "b.gml"
    assert main(["city", "convert", str(source), str(target), "--to-crs", "EPSG:25833+5783"]) == 2
    assert "--to-crs EPSG:25833." in capsys.readouterr().err
    assert not target.exists()
    for crs in ("EPSG:25833", "EPSG:25833+7837"):
        assert main(["city", "convert", str(source), "-o", str(target), "--to-crs", crs]) == 0
        assert read_city_model(target).crs == "EPSG:25833+7837"
