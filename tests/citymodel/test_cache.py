"""What names a scene in the cache: all that it follows from."""

from dataclasses import replace
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from lodbench.citymodel import cache, open_scene, read_city_model
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.options import ReadOptions
from lodbench.errors import CityModelError
from lodbench.plugins import PlugIn
from lodbench.storage import digest
from tests.citymodel.footprint_files import squares
from tests.town import box_obj


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
