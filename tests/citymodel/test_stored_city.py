"""Scenes that were converted: what they were made with is not changed by asking again."""

from pathlib import Path

import pytest

from lodbench.citymodel.cache import open_cached_city
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene_file import read_scene, write_scene
from lodbench.cli import main
from lodbench.errors import CityModelError
from tests.citymodel.gml_text import box_city, write


@pytest.fixture(params=["file", "tiles"])
def scene(request, tmp_path) -> Path:
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
def test_other_options_than_a_scene_was_made_with_are_refused(scene, options, roof_height, told):
    asked = {"options": ReadOptions(**options), "roof_height": roof_height}
    if not told:
        assert open_cached_city(scene, **asked).scene.num_buildings
        return
    with pytest.raises(CityModelError, match=told) as caught:
        open_cached_city(scene, **asked)
    assert "Leave" in caught.value.hint


def test_a_scene_that_does_not_say_how_it_was_made_is_opened(scene):
    stored, extra = read_scene(scene)
    write_scene(stored, scene, {key: value for key, value in extra.items() if key != "made_with"})
    assert open_cached_city(scene, options=ReadOptions(layers=("roads",))).scene.num_buildings
