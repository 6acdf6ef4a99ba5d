"""`lodbench city convert`: a city named twice is read once, and a fault leaves nothing behind."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lodbench.cli import main
from tests.citymodel.gml_text import box_city, box_rings, city, member, polygon, solid, surface_members, write


def box(name: str, east: float, lod: int) -> str:
    return member(solid(surface_members(map(polygon, box_rings(east))), lod), name)


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
