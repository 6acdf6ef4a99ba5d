"""`lodbench bench` refuses options that what was asked for does not read, before any work."""

from __future__ import annotations

import pytest

from lodbench.cli import main


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("segmentation --data SET --town train", "--town is not used with --data."),
        ("segmentation --data SET --method region", "--method is not used with --data."),
        ("segmentation --data SET --draws 2", "--draws is not used with --data."),
        ("segmentation --method region", "--method is not used with a town."),
        ("segmentation --seed 3", "--seed is not used with a town."),
        ("segmentation --photos DIR --draws 2", "--draws is not used with --photos."),
        ("segmentation --photos DIR --guided-by 20,2 --views 3", "--views is not used with --guided-by."),
        ("segmentation --data SET --instances --city FILE", "--city is not used with --instances."),
        ("segmentation --city FILE --town train", "--town is not used with --city."),
        ("real --query DIR --city . --map-error 3", "--map-error is of maps that --photos makes"),
        ("real --photos DIR --lod 2", "--lod is of a --city"),
        ("real --photos DIR --crs EPSG:25832", "--crs is of a --city"),
        ("training-data --workers 0", "workers=0 is not within 1 to 1024."),
    ],
)
def test_an_option_that_is_not_read_is_refused(words, told, capsys):
    assert main(["bench", *words.split()]) == 2
    assert told in capsys.readouterr().err


def test_props_are_not_those_of_the_demo_town(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("lodbench.cli.bench.city_file", lambda given: tmp_path / "town.gml")
    assert main(["bench", "training-data", "--props", "props.npz"]) == 2
    assert "--props is not used with the demo town" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("accuracy --building-share 0.9,0.1", "--building-share 0.1 is not within 0.9 to 1."),
        ("accuracy --views 0", "--views 0 is not a number of views."),
        ("accuracy --world focl=1", "--world focl=1: focl is not a setting."),
        ("silhouettes --views 0", "lodbench: views, hypotheses"),
        ("city --tiles -1", "tiles at least 0"),
        ("training-data --views 1", "views=1 is too few to measure."),
        ("training-data --props props.npz", "--props is not used with the demo town"),
    ],
)
def test_no_demo_town_is_made_for_options_that_are_refused(words, told, monkeypatch, capsys):
    monkeypatch.setattr("lodbench.synthesis.demo.open_demo", lambda _: pytest.fail("the town was made"))
    assert main(["bench", *words.split()]) == 2
    assert told in capsys.readouterr().err
