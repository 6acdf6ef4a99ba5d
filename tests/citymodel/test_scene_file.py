"""Scene folders: what comes back, and what is refused."""

import contextlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.scene_file import read_scene, write_scene
from lodbench.errors import CityModelError
from lodbench.storage.digest import text_check

from .gml_text import box_city


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    path = tmp_path / "a.gml"
    path.write_text(box_city(), encoding="utf-8")
    return open_scene(path)


@pytest.fixture
def folder(tmp_path: Path, scene: Scene) -> Path:
    write_scene(scene, tmp_path / "a.scene", {"note": "x"})
    return tmp_path / "a.scene"


def test_comes_back_mapped(scene: Scene, folder: Path) -> None:
    again, extra = read_scene(folder)
    assert extra == {"note": "x"}
    assert isinstance(again.vertices, np.memmap)
    for name in ("vertices", "triangles", "vertex_starts", "triangle_starts", "origin"):
        np.testing.assert_array_equal(getattr(again, name), getattr(scene, name))
        assert getattr(again, name).dtype == getattr(scene, name).dtype
    assert (again.building_ids, again.lod, again.crs) == (scene.building_ids, scene.lod, scene.crs)


@pytest.mark.attack
def test_every_changed_byte_is_refused(folder: Path) -> None:
    tried = 0
    for file in sorted(folder.iterdir()):
        whole = file.read_bytes()
        for place in range(0, len(whole), 7):
            file.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
            with pytest.raises(CityModelError):
                read_scene(folder)
            tried += 1
        file.write_bytes(whole)
    assert tried > 150
    assert read_scene(folder)[0].num_buildings == 1


def bad_index(scene: Scene, value: int) -> Scene:
    triangles = scene.triangles.copy()
    triangles[-1, 1] = value
    return replace(scene, triangles=triangles)


@pytest.mark.attack
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda s: bad_index(s, 2**31 - 1), "a corner that its building has not"),
        (lambda s: bad_index(s, -1), "a corner that its building has not"),
        (lambda s: bad_index(s, len(s.vertices)), "a corner that its building has not"),
        (lambda s: replace(s, vertices=s.vertices * np.float32(np.nan)), "not finite"),
        (lambda s: replace(s, vertices=s.vertices.astype(np.float64)), "vertices is float64"),
        (lambda s: replace(s, triangles=s.triangles[:, :2]), "triangles is int32"),
        (lambda s: replace(s, triangles=s.triangles[:-1]), "do not follow each other"),
        (lambda s: replace(s, vertex_starts=s.vertex_starts[::-1]), "do not follow each other"),
        (lambda s: replace(s, building_ids=("a", "b")), "vertex_starts is int64"),
        (lambda s: replace(s, origin=np.full(3, 1e999)), "not"),
    ],
)
def test_a_stranger_s_numbers_are_refused_whatever_their_digests(scene, tmp_path, change, reason):
    target = tmp_path / "b.scene"
    try:
        write_scene(change(scene), target)
    except ValueError:  # cannot even be written
        return
    with pytest.raises(CityModelError, match=reason):
        read_scene(target)


@pytest.mark.attack
@pytest.mark.parametrize("key", ["arrays", "building_ids", "lod", "crs", "origin", "extra"])
@pytest.mark.parametrize("value", [None, [], {}, "x", 5, ["x"], {"findings": "x"}])
def test_a_stranger_s_words_end_in_no_traceback(folder: Path, key: str, value: object) -> None:
    meta = json.loads((folder / "scene.json").read_text())
    meta["about"][key] = value
    meta["check"] = text_check(json.dumps(meta["about"]))
    (folder / "scene.json").write_text(json.dumps(meta))
    # Some other values are as good: a level of detail of another name, no reference system.
    with contextlib.suppress(CityModelError):
        read_scene(folder)


def test_another_version(scene: Scene, folder: Path, tmp_path: Path) -> None:
    (folder / "scene.json").write_text('{"version": 2}')
    (folder / "boxes.npy").write_bytes(b"")
    with pytest.raises(CityModelError, match="another version"):
        read_scene(folder)
    write_scene(scene, folder)
    assert read_scene(folder)[0].digest() == scene.digest()
    assert not (folder / "boxes.npy").exists()
    with pytest.raises(CityModelError, match="no scene"):
        read_scene(tmp_path)


def test_in_place_of_a_scene_but_of_nothing_else(scene: Scene, folder: Path, tmp_path: Path) -> None:
    write_scene(replace(scene, lod="9"), folder)
    assert read_scene(folder)[0].lod == "9"
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError):
        write_scene(scene, folder)
    assert (folder / "notes.txt").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
