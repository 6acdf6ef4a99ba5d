from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from lodbench.bench.grown_city import TILE_BUILDINGS, grown_city, open_grown_city
from lodbench.bench.scale import ScaleOptions, figures_of, is_inside, measure_scale, swarms_inside
from lodbench.citymodel.scene_file import read_scene
from lodbench.cli import main
from lodbench.errors import ConfigError
from lodbench.rendering import engine_store
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.synthesis.view_sampling import FINE_SIZE, RGB_CAMERA

QUICK = ScaleOptions(buildings=2300, num_views=2, hypotheses=14, horizon_hypotheses=2, repeats=1)


@pytest.fixture(scope="module")
def core():
    return grown_city(TILE_BUILDINGS)


def solid_volume(scene, b):
    """Returns the volume a building's triangles enclose: right only if they are closed and face out."""
    corners = scene.vertices[scene.triangles[scene.triangle_starts[b] : scene.triangle_starts[b + 1]]]
    a, b, c = np.moveaxis(corners.astype(np.float64), 1, 0)
    return float((a * np.cross(b, c)).sum() / 6.0)


class TestGrownCity:
    def test_a_larger_one_holds_the_smaller_bit_for_bit(self, core):
        larger = grown_city(2300)
        assert larger.num_buildings == 2300
        for name, axis in (("vertices", "vertex_starts"), ("triangles", "triangle_starts")):
            count = getattr(core, axis)[-1]
            assert getattr(larger, axis)[: TILE_BUILDINGS + 1].tolist() == getattr(core, axis).tolist()
            np.testing.assert_array_equal(getattr(larger, name)[:count], getattr(core, name))
        assert larger.building_ids[:TILE_BUILDINGS] == core.building_ids

    def test_one_that_ends_within_a_tile_has_the_same_buildings(self, core):
        part = grown_city(130)
        assert part.vertices.tobytes() == core.vertices[: core.vertex_starts[130]].tobytes()

    def test_buildings_are_closed_solids_that_stand_apart(self, core):
        volumes = [solid_volume(core, b) for b in range(0, TILE_BUILDINGS, 7)]
        assert min(volumes) > 13 * 13 * 6 * 0.4
        assert max(volumes) < 24 * 30 * 56
        assert len(set(np.diff(core.triangle_starts))) == 3

    def test_rings_surround_the_core(self):
        city = grown_city(9 * TILE_BUILDINGS)
        low, high = city.extent_m
        inner_low, inner_high = grown_city(TILE_BUILDINGS).extent_m
        assert (low[:2] < inner_low[:2] - 900).all()
        assert (high[:2] > inner_high[:2] + 900).all()
        assert len(set(city.building_ids)) == city.num_buildings

    def test_another_seed_is_another_city(self, core):
        assert grown_city(TILE_BUILDINGS, 1).digest() != core.digest()

    def test_is_made_once(self, core, tmp_path, monkeypatch):
        monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path))
        steps = []
        folder = open_grown_city(TILE_BUILDINGS, 0, lambda *step: steps.append(step))
        assert open_grown_city(TILE_BUILDINGS, 0, lambda *step: steps.append(step)) == folder
        assert steps == [(1, 1)]
        assert read_scene(folder)[0].digest() == core.digest()


class TestViews:
    def test_the_footprint_lies_in_the_core(self, core):
        engine, camera = SilhouetteRenderer(core, 1), RGB_CAMERA.scaled(*FINE_SIZE)
        swarms, rejections = swarms_inside(engine, camera, QUICK)
        assert len(swarms) == 2
        fewer, before = swarms_inside(engine, camera, replace(QUICK, num_views=1))
        np.testing.assert_array_equal(fewer[0].centers, swarms[0].centers)
        assert 0 <= before <= rejections
        low, high = core.extent_m
        for swarm in swarms:
            # A border pixel's ray, cast from each hypothesis on its own.
            for u, v in ((0, 0), (602, 0), (0, 448), (602, 448), (301, 0)):
                ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
                for rotation, center in zip(swarm.rotations, swarm.centers, strict=True):
                    world = rotation.T @ ray
                    ground = center - world * center[2] / world[2]
                    assert (ground[:2] > low[:2]).all()
                    assert (ground[:2] < high[:2]).all()
        assert not is_inside(grown_city(130), camera, swarms[0])


def test_both_cities_count_alike(tmp_path, monkeypatch):
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path))
    monkeypatch.setattr(engine_store, "_STORED_FROM_TRIANGLES", 1000)
    steps = []
    report = measure_scale(QUICK, lambda *step: steps.append(step))
    assert report.data["views"].tolist() == ["footprint in the core"] * 2 + ["to the horizon"] * 2
    assert (report.data["different"][:2] == 0).all()
    assert (report.data[["core_us", "whole_us"]] > 0).all(axis=None)
    figures = {figure.figure: figure.value for figure in report.figures}
    assert figures["opening"] > 0
    assert figures["on disk"] > 2300 * 22 * 12 / 1e6
    assert "Opened in" in report.text
    assert len(list((tmp_path / "engine").iterdir())) == 1
    assert steps == [(1, 3), (2, 3), (3, 3), (1, 2), (2, 2), (1, 2), (2, 2)]
    json.dumps([figure.to_json() for figure in report.figures], allow_nan=False)


def test_costs_are_means_beside_the_cores():
    rows = [("footprint in the core", 100.0, 120.0, 1), ("footprint in the core", 200.0, 240.0, 2)]
    timings = pd.DataFrame(rows, columns=["views", "core_us", "whole_us", "different"])
    cost, different = figures_of(timings, 5000)
    assert (cost.value, cost.peer_value, cost.ratio) == (180.0, 150.0, pytest.approx(1 / 1.2))
    assert different.value == 3


@pytest.mark.parametrize("values", [{"buildings": 999}, {"num_views": 0}, {"repeats": 0}])
def test_options_that_make_no_sense(values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        ScaleOptions(**values)


def test_the_command_refuses_a_city_smaller_than_its_core(capsys):
    assert main(["bench", "scale", "--buildings", "10"]) == 2
    assert "buildings=10" in capsys.readouterr().err
