"""`lodbench city make`: what it writes of footprints, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lodbench.cli import main
from tests.citymodel.surface_case import heights_of, rectangle, write_footprints, write_raster
from tests.reporting.browser import PHONE, opened

pytest.importorskip("rasterio")
pytest.importorskip("pyogrio")

HOUSES = [(10.0, 10.0, 22.0, 20.0, 6.0), (40.0, 12.0, 48.0, 30.0, 9.5), (60.0, 60.0, 90.0, 80.0, 3.2)]


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Footprints, two of them over a surface model; a third has a height, a fourth nothing."""
    monkeypatch.chdir(tmp_path)
    shapes = [*(rectangle(*house) for house in HOUSES), rectangle(300, 300, 310, 310)]
    nothing = float("nan")
    write_footprints(
        tmp_path / "f.gpkg", shapes, id=["a", "b", "c", "<d>"], height=[nothing, 1.0, 7.5, nothing]
    )
    write_raster(tmp_path / "dsm.tif", heights_of(HOUSES[:2]))
    write_raster(tmp_path / "dtm.tif", heights_of([]))
    return tmp_path


WORDS = ["city", "make", "--footprints", "f.gpkg", "--dsm", "dsm.tif", "--dtm", "dtm.tif"]


def test_a_city_and_a_page_of_what_came_from_where(folder, capsys):
    assert main([*WORDS, "town.city.json", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["heights_from"] == {"surface model": 2, "column height": 1}
    assert told["left_out"] == {"no height": 1}
    objects = json.loads((folder / "town.city.json").read_text())["CityObjects"]
    heights = {name: each["attributes"]["measuredHeight"] for name, each in objects.items()}
    assert heights == pytest.approx({"a": 6.0, "b": 9.5, "c": 7.5}, abs=0.1)
    assert objects["c"]["attributes"]["height_from"] == "column height"
    page = (folder / "town.city.html").read_text()
    assert "&lt;d&gt;" in page
    for scheme, size in (("light", PHONE), ("dark", PHONE)):
        with opened(folder / "town.city.html", size, scheme) as (shown, complaints):
            assert shown.locator(".map path[class^=kind]").count() == 3
            assert shown.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert complaints == []


def test_for_people(folder, capsys):
    assert main([*WORDS, "town.gml"]) == 0
    text = capsys.readouterr().out
    for words in ("3 buildings", "2  height from surface model", "1  left out: no height", "town.html"):
        assert words in text
    assert main(["city", "check", "town.gml"]) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["city", "make", "town.city.json"], "--footprints"),
        ([*WORDS, "f.gpkg"], "f.gpkg"),
        (["city", "make", "--footprints", "dsm.tif", "town.json"], "no file of footprints"),
        (
            ["city", "make", "--footprints", "f.gpkg", "--dsm", "no.tif", "town.json"],
            "no surface model at no.tif",
        ),
        (["city", "make", "--footprints", "f.gpkg", "--dsm", "dsm.tif", "town.docx"], "town.docx"),
    ],
)
def test_refused_in_one_line_with_nothing_written(folder, capsys, words, said):
    before = sorted(path.name for path in folder.iterdir())
    assert main(words) == 2
    assert said in capsys.readouterr().err
    assert sorted(path.name for path in folder.iterdir()) == before
