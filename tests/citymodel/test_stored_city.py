"""Scenes that were converted: what they were made with is not changed by asking again."""

import contextlib
import json
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import cache, open_scene, read_city_model
from lodbench.citymodel.cache import open_cached_city
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.scene_file import read_scene, write_scene
from lodbench.cli import main
from lodbench.errors import CityModelError
from lodbench.plugins import PlugIn
from lodbench.storage import digest
from lodbench.storage.digest import text_check
from tests.citymodel.gml_text import box_city, squares, write
from tests.town import box_obj


@pytest.fixture(params=["file", "tiles"])
def made(request, tmp_path) -> Path:
    """A scene with bridges, walls sunk by 2 m, its LoD1 derived where there is none."""
    (tmp_path / "tiles").mkdir()
    for name in ("a.gml", "tiles/a.gml", "tiles/b.gml"):
        write(tmp_path / name, box_city())
    source = "a.gml" if request.param == "file" else "tiles"
    words = ["--layers", "bridges", "--option", "base=sunk", "--option", "sunk_m=2"]
    words += ["--lod", "1", "--roof-height", "median"]
    words += ["--executor", "serial"] if request.param == "tiles" else []
    assert main(["city", "convert", str(tmp_path / source), str(tmp_path / "t.scene"), *words]) == 0
    return tmp_path / "t.scene"


@pytest.mark.parametrize(
    ("options", "roof_height", "told"),
    [
        ({}, None, ""),
        ({"layers": ("bridges",), "base": "sunk", "sunk_m": 2.0}, "median", ""),
        ({"layers": ("roads",)}, None, "made with layers=bridges: layers=roads would change nothing"),
        ({"ground_m": 7.0}, None, "made without ground_m: ground_m=7.0 would change nothing"),
        ({}, "max", "made with roof_height=median: roof_height=max would change nothing"),
    ],
)
def test_other_options_than_a_scene_was_made_with_are_refused(made, options, roof_height, told):
    asked = {"options": ReadOptions(**options), "roof_height": roof_height}
    if not told:
        assert open_cached_city(made, **asked).scene.num_buildings
        return
    with pytest.raises(CityModelError, match=told) as caught:
        open_cached_city(made, **asked)
    assert "Leave" in caught.value.hint


def test_a_scene_that_does_not_say_how_it_was_made_is_opened(made):
    stored, extra = read_scene(made)
    write_scene(stored, made, {key: value for key, value in extra.items() if key != "made_with"})
    assert open_cached_city(made, options=ReadOptions(layers=("roads",))).scene.num_buildings


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


@pytest.fixture
def key(tmp_path):
    """Returns the name of a scene that some reader makes."""
    city = tmp_path / "city.obj"
    city.write_text(box_obj())

    def of(reader: str | None = None) -> str:
        cache.code_digest.cache_clear()
        return cache.scene_key(city, None, ReadOptions(reader=reader), None)

    yield of
    cache.code_digest.cache_clear()


def test_another_reader_s_code_makes_another_scene(key, tmp_path, monkeypatch):
    """Who mends a reader of a package of their own would be given what the former one read."""
    module = tmp_path / "packages" / "skyline_city" / "reader.py"
    module.parent.mkdir(parents=True)
    (module.parent / "__init__.py").write_text("")
    module.write_text("LIFT_M = 0\n")
    monkeypatch.syspath_prepend(tmp_path / "packages")
    point = EntryPoint("blocks", "skyline_city.reader:read_blocks", "lodbench.city_readers")
    blocks, find = PlugIn("city_readers", "blocks", "skyline 1.0", point), cache.find_plugin
    monkeypatch.setattr(cache, "find_plugin", lambda group, n: blocks if n == "blocks" else find(group, n))
    before, ours = key("blocks"), key("obj")
    module.write_text("LIFT_M = 3\n")
    assert key("blocks") != before
    assert key("obj") == ours == key("obj")


@pytest.mark.parametrize("library", ["shapely", "rasterio"])
def test_another_version_of_what_reads_makes_another_scene(key, monkeypatch, library):
    before, there = key(), digest.version
    monkeypatch.setattr(digest, "version", lambda name: "0.1" if name == library else there(name))
    assert key() != before


def test_a_shapefile_with_brackets_in_its_name_is_told_by_its_content(tmp_path):
    """Browsers name a second download so; two of them were one city."""
    pytest.importorskip("pyogrio")
    keys = []
    for number, count in ((1, 3), (2, 4)):
        city = squares(tmp_path / f"houses [{number}].shp", count)
        keys.append(cache.scene_key(city, None, ReadOptions(), None))
    assert keys[0] != keys[1]


def test_what_a_gis_has_not_written_into_a_geopackage_yet_counts(tmp_path):
    pytest.importorskip("pyogrio")
    city = squares(tmp_path / "houses.gpkg", driver="GPKG")
    before = cache.scene_key(city, None, ReadOptions(), None)
    (tmp_path / "houses.gpkg-wal").write_bytes(b"a house more")
    assert cache.scene_key(city, None, ReadOptions(), None) != before


@pytest.mark.parametrize(("own", "others"), [("EPSG:25832", "EPSG:25833"), (None, "EPSG:25832")])
def test_a_scene_of_another_reference_system_is_refused(tmp_path, own, others):
    """What is asked for was not heard: latitudes and longitudes were those of the scene's own system."""
    city, target = tmp_path / "city.obj", tmp_path / "city.scene"
    city.write_text(box_obj())
    convert_city(read_city_model(city, crs=own), target)
    for crs in (None, "EPSG:4326", *([] if own is None else [own, f"{own}+7837"])):
        assert cache.open_cached_city(target, options=ReadOptions(crs=crs)).scene.crs == own
    with pytest.raises(CityModelError, match=f"not in {others}"):
        cache.open_cached_city(target, options=ReadOptions(crs=others))


@pytest.mark.parametrize(("north", "is_read"), [(6_600_000.0, False), (10_000.0, True)])
def test_a_scene_in_mercator_of_the_whole_world_is_read_at_the_equator_alone(tmp_path, north, is_read):
    """Earlier versions wrote such scenes, at 51 degrees north with houses 1.6 times too large."""
    city = tmp_path / "city.obj"
    city.write_text(box_obj())
    scene = open_scene(city)
    placed = replace(scene, crs="EPSG:3857+5773", origin=np.array([650_000.0, north, 0.0]))
    target = tmp_path / "city.scene"
    cache.store_city(cache.OpenCity(placed, {}, 1.0, 0.0), target)
    if is_read:
        assert cache.open_cached_city(target).scene.crs == "EPSG:3857+5773"
    else:
        with pytest.raises(CityModelError, match="no metres there"):
            cache.open_cached_city(target)
