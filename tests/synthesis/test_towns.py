"""``city=demo:...``: which built-in town is pictured, and at which level."""

from __future__ import annotations

import pytest

from lodbench.cli import main
from lodbench.cli.render import with_demo
from lodbench.synthesis import demo
from lodbench.synthesis.training_data.params import GenerateParams


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """Collects which towns are wanted instead of building them."""
    towns = []

    def folder(params):
        towns.append((params.look, params.town_seed))
        return tmp_path

    monkeypatch.setattr(demo, "demo_folder", folder)
    return towns


@pytest.mark.parametrize(
    ("city", "lod", "town", "file", "level"),
    [
        ("demo", None, ("train", 1), "town.gml", "2"),
        ("demo:7", None, ("train", 7), "town.gml", "2"),
        ("demo:7", "3", ("train", 7), "town_lod3.gml", "3"),
        ("demo:test", "3", ("test", 0), "town_lod3.gml", "3"),
    ],
)
def test_towns_are_named_by_seed(asked, tmp_path, city, lod, town, file, level):
    params = with_demo(GenerateParams(city=city, out="set", lod=lod))
    assert asked == [town]
    assert (params.city, params.lod) == (str(tmp_path / file), level)
    assert params.props == str(tmp_path / "props.npz")


def test_another_city_stays_as_it_is(asked):
    params = GenerateParams(city="demolition.gml", out="set")
    assert with_demo(params) == params
    assert not asked


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("sheet=0", "sheet=0 is not within 16 to 2048"),
        ("texture_model=mesh.obj", "texture_model is not used with city=demo,"),
    ],
)
def test_no_town_is_built_for_settings_that_are_wrong(asked, tmp_path, capsys, word, told):
    assert main(["generate-training-data", "city=demo", f"out={tmp_path / 'o'}", word]) == 2
    assert told in capsys.readouterr().err
    assert not asked


def test_an_unknown_town_is_named(tmp_path, capsys):
    assert main(["generate-training-data", "city=demo:old", f"out={tmp_path / 'o'}"]) == 2
    message = capsys.readouterr().err
    assert "demo:old" in message
    assert "demo:SEED" in message
