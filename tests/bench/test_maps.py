"""`lodbench bench maps`: its table, figures and picture from answers, and what it refuses."""

import numpy as np
import pandas as pd
import pytest

from lodbench.bench import Figure, maps
from lodbench.bench.maps import MapsOptions, measure_maps
from lodbench.citymodel import open_scene
from lodbench.citymodel.extrude import scene_of_blocks
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.evaluation.metrics import ERROR
from tests.town import write_dataset


@pytest.fixture
def answered(monkeypatch):
    """Answers of two methods: over the surface model all are found, over the blocks those in place."""
    asked = []

    def queries_of(demo, survey, name, method, options):
        asked.append((name, method))
        is_found = np.array([True, True, name == "DSM", name == "DSM"])
        return pd.DataFrame(
            {
                ERROR[0]: np.where(is_found, 0.5, 40.0),
                ERROR[1]: np.where(is_found, 0.1, 9.0),
                "split": ["in_place", "in_place", "out_of_place", "out_of_place"],
                "map": name,
                "method": method,
                "triangles": 12_000,
                "cpu_s": 1.5,
            }
        )

    class Demo:
        root, version = None, "town 0"

    monkeypatch.setattr(maps, "_queries_of", queries_of)
    monkeypatch.setattr(maps, "open_demo", lambda params: Demo())
    monkeypatch.setattr(maps, "surveyed", lambda root, seed: None)
    monkeypatch.setattr(maps, "_costs", lambda demo, survey: [Figure("a hypothesis, DSM", 90.0, "us")])
    monkeypatch.setattr(maps, "_roof_heights", lambda demo, survey: [Figure("stand free", 3.0, "")])
    return asked


def test_a_row_per_map_and_method_and_a_picture(answered, tmp_path):
    report = measure_maps(MapsOptions(maps=("LoD1", "DSM")))
    assert answered == [(m, k) for m in ("LoD1", "DSM") for k in ("region", "contour_alignment")]
    rows = {line[:26].strip(): line.split() for line in report.text.splitlines() if "12,000" in line}
    assert [row[-6:-4] for row in rows.values()] == [
        ["100", "0"],
        ["100", "0"],
        ["100", "100"],
        ["100", "100"],
    ]
    found = {each.figure: each.value for each in report.figures}
    assert found["within (2 m, 2 deg), region, LoD1, out_of_place"] == 0.0
    assert found["within (2 m, 2 deg), region, DSM, out_of_place"] == 100.0
    assert found["median error, region, DSM"] == 0.5
    assert (found["a hypothesis, DSM"], found["stand free"]) == (90.0, 3.0)
    assert "stand free" in report.text
    report.write_pictures(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"maps.png", "maps.svg"}


def test_methods_that_need_textures_run_over_maps_with_some(answered):
    methods = ("region", "uavd4l:matcher=xfeat")
    measure_maps(MapsOptions(methods=methods, maps=("LoD2", "DSM + orthophoto", "textured mesh")))
    assert answered == [
        ("LoD2", "region"),
        ("DSM + orthophoto", "region"),
        ("DSM + orthophoto", "uavd4l:matcher=xfeat"),
        ("textured mesh", "uavd4l:matcher=xfeat"),
    ]


def test_without_methods_the_surface_model_alone_is_measured(answered):
    report = measure_maps(MapsOptions(methods=()))
    assert answered == []
    assert [each.figure for each in report.figures] == ["a hypothesis, DSM", "stand free"]


def test_costs_are_positive_and_their_ratios_those_of_the_times(monkeypatch, tmp_path):
    root, city = write_dataset(tmp_path, count=2)
    dataset, scene = open_folder(FolderParams(str(root), str(city))), open_scene(city)
    monkeypatch.setattr(maps, "_over", lambda demo, survey, name: (demo, scene))
    monkeypatch.setattr(maps, "_HYPOTHESES", 16)
    found = {each.figure: each.value for each in maps._costs(dataset, tmp_path)}
    us = {name: found[f"a hypothesis, {name}, 602 x 448, one core"] for name in ("DSM", "DSM blocks", "LoD1")}
    assert us["DSM"] > 0
    for name in ("DSM blocks", "LoD1"):
        assert found[f"a hypothesis, DSM, times {name}"] == pytest.approx(us["DSM"] / us[name])


def test_blocks_are_compared_with_buildings_that_stand_free():
    """One is 0.3 m too high, one is not there, one is half as wide; two that touch do not count."""
    truth = [
        (0, 0, 10, 10, 0, 9),
        (30, 0, 40, 10, 0, 6),
        (60, 0, 70, 12, 0, 7),
        (0, 40, 10, 50, 0, 8),
        (11, 40, 21, 50, 0, 8),
    ]
    blocks = [(0, 0, 10, 10, 0, 9.3), (60, 0, 70, 4, 0, 7), (0, 40, 21, 50, 0, 20)]
    errors = maps.block_errors(scene_of_blocks(truth), scene_of_blocks(blocks))
    np.testing.assert_allclose(np.sort(errors), [0.3, np.inf, np.inf], atol=1e-3)
