"""`lodbench city convert` and `city make`: what they write and refuse; a fault leaves nothing behind."""

import json
from pathlib import Path

import pytest

from lodbench.cli import main
from tests.citymodel.gml_text import box_city, box_rings, city, member, solid_of, write
from tests.citymodel.surface_case import heights_of, rectangle, write_footprints, write_raster
from tests.reporting.browser import PHONE, opened


def box(name: str, east: float, lod: int) -> str:
    return member(solid_of(box_rings(east), lod), name)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Where a city lies, and the same as two tiles."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiles").mkdir()
    for name, east in (("a.gml", 500000.0), ("tiles/a.gml", 500000.0), ("tiles/b.gml", 500500.0)):
        write(tmp_path / name, city(box(f"at {east:g}", east, 1)))
    return tmp_path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("words", "count", "told"),
    [
        (["a.gml", "a.gml"], 1, "a.gml is named twice: it is read once"),
        (["a.gml", "../{}/a.gml"], 1, "a.gml is named twice"),
        (["tiles", "tiles/b.gml"], 2, "tiles/b.gml lies in tiles: it is read once"),
        (["tiles/b.gml", "a.gml"], 2, ""),
    ],
)
def test_a_city_named_twice_is_read_once(capsys, folder, words, count, told):
    words = [word.format(folder.name) for word in words]
    assert main(["city", "convert", *words, "-o", "out.city.json", "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["buildings"] == count
    assert "LB205" not in printed.out
    assert told in printed.err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["tiles", "out.scene", "--lod", "9"], "level of detail 9"),
        (["tiles", "out.scene", "--lod", "1", "--roof-height", "meidan"], "--roof-height=meidan is"),
        (["a.gml", "out.scene", "--lod", "9"], "level of detail 9"),
        (["a.gml", "new/t.gml", "--tiles", "100", "--lod", "9"], "level of detail 9"),
        (["a.gml", "new/t.gml", "--tiles", "100", "--id", "nix"], "nix"),
    ],
)
def test_a_fault_leaves_nothing(capsys, folder, words, told):
    before = names(folder)
    assert main(["city", "convert", *words]) == 2
    assert told in capsys.readouterr().err
    assert names(folder) == before


def test_tiles_of_a_cut_that_ends_in_a_fault_are_not_left(capsys, folder):
    """The second has no building of the level; what another program wrote stays."""
    write(folder / "mixed.gml", city(box("low", 500000.0, 1) + box("high", 500500.0, 2)))
    (folder / "cut").mkdir()
    (folder / "cut" / "notes.txt").write_text("mine")
    assert main(["city", "convert", "mixed.gml", "cut/t.glb", "--tiles", "100", "--lod", "1"]) == 2
    assert "level of detail 1" in capsys.readouterr().err
    assert names(folder / "cut") == ["notes.txt"]


def test_tiles_that_are_done_wait_for_one_that_is_mended(capsys, folder):
    (folder / "tiles" / "c.gml").write_text(box_city()[:-400])
    assert main(["city", "convert", "tiles", "out.scene", "--executor", "serial"]) == 2
    assert "out.scene.parts" in names(folder)
    write(folder / "tiles" / "c.gml", box_city())
    assert main(["city", "convert", "tiles", "out.scene", "--executor", "serial"]) == 0
    assert "out.scene.parts" not in names(folder)


pytest.importorskip("rasterio")
pytest.importorskip("pyogrio")

HOUSES = [(10.0, 10.0, 22.0, 20.0, 6.0), (40.0, 12.0, 48.0, 30.0, 9.5), (60.0, 60.0, 90.0, 80.0, 3.2)]


@pytest.fixture
def folder_of_city_make(tmp_path, monkeypatch) -> Path:
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


def test_a_city_and_a_page_of_what_came_from_where(folder_of_city_make, capsys):
    assert main([*WORDS, "town.city.json", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["heights_from"] == {"surface model": 2, "column height": 1}
    assert told["left_out"] == {"no height": 1}
    objects = json.loads((folder_of_city_make / "town.city.json").read_text())["CityObjects"]
    heights = {name: each["attributes"]["measuredHeight"] for name, each in objects.items()}
    assert heights == pytest.approx({"a": 6.0, "b": 9.5, "c": 7.5}, abs=0.1)
    assert objects["c"]["attributes"]["height_from"] == "column height"
    page = (folder_of_city_make / "town.city.html").read_text()
    assert "&lt;d&gt;" in page
    for scheme, size in (("light", PHONE), ("dark", PHONE)):
        with opened(folder_of_city_make / "town.city.html", size, scheme) as (shown, complaints):
            assert shown.locator(".map path[class^=kind]").count() == 3
            assert shown.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert complaints == []


def test_for_people(folder_of_city_make, capsys):
    assert main([*WORDS, "town.gml"]) == 0
    text = capsys.readouterr().out
    for words in ("3 buildings", "2  height from surface model", "1  left out: no height", "town.html"):
        assert words in text
    assert main(["city", "check", "town.gml"]) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([*WORDS, "f.gpkg"], "f.gpkg"),
        (
            ["city", "make", "--footprints", "f.gpkg", "--dsm", "no.tif", "town.json"],
            "no surface model at no.tif",
        ),
        (["city", "make", "--footprints", "f.gpkg", "--dsm", "dsm.tif", "town.docx"], "town.docx"),
    ],
)
def test_refused_in_one_line_with_nothing_written(folder_of_city_make, capsys, words, said):
    before = sorted(path.name for path in folder_of_city_make.iterdir())
    assert main(words) == 2
    assert said in capsys.readouterr().err
    assert sorted(path.name for path in folder_of_city_make.iterdir()) == before
