"""Blocks of roofs that are told to be pitched: lower beforehand than the map has them."""

from dataclasses import replace

import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel.extrude import pitched_blocks
from lodbench.citymodel.meshing import mesh_model
from lodbench.citymodel.read import read_city_model
from lodbench.errors import ConfigError
from lodbench.methods.region import RegionParams
from lodbench.methods.region.roofs import RaisedRoofs
from tests.methods.test_region_roofs import FAST, mean_errors


@pytest.fixture
def told(scene):
    """The town, of whose buildings every other one is told to have a pitched roof."""
    return replace(scene, pitched=np.arange(scene.num_buildings) % 2 == 0)


def modes_found(scene):
    return np.maximum.reduceat(scene.vertices[:, 2], scene.vertex_starts[:-1])


def test_they_are_drawn_lower_and_the_others_as_they_are(scene, city_map, told):
    for step in (0, 2):
        plain = RaisedRoofs(city_map, scene, 0.8).at(step).scene
        lowered = RaisedRoofs(city_map, told, 0.8).at(step).scene
        np.testing.assert_allclose(modes_found(plain) - modes_found(lowered), 0.8 * told.pitched, atol=1e-4)
        floors = [np.minimum.reduceat(s.vertices[:, 2], s.vertex_starts[:-1]) for s in (plain, lowered)]
        np.testing.assert_array_equal(*floors)


def test_roofs_by_themselves_are_counted_from_there(city_map, told):
    own_m = np.linspace(-0.5, 0.5, told.num_buildings)
    roofs = RaisedRoofs(city_map, told, 0.8)
    moved = modes_found(roofs.with_offsets(own_m, 0.0, 0.0).at(0).scene) - modes_found(roofs.at(0).scene)
    np.testing.assert_allclose(moved, own_m, atol=1e-4)


def test_what_is_drawn_with_its_roof_is_no_block(shared_data):
    model = read_city_model(shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml")
    blocks = mesh_model(model, "1", roof_height="median").scene
    assert int(pitched_blocks(blocks).sum()) == int(blocks.pitched.sum()) == 48
    assert not pitched_blocks(mesh_model(model, "2").scene).any()


def test_floors_may_follow_the_ground(shared_data):
    model = read_city_model(shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml")
    blocks = mesh_model(model, "1", roof_height="median").scene
    vertices = blocks.vertices.copy()
    owner = np.repeat(np.arange(blocks.num_buildings), np.diff(blocks.vertex_starts))
    floors = np.minimum.reduceat(vertices[:, 2], blocks.vertex_starts[:-1])
    is_floor = vertices[:, 2] < floors[owner] + 0.1
    vertices[is_floor, 2] += 0.1 * (vertices[is_floor, 0] - vertices[:, 0].mean()) % 1.0
    assert int(pitched_blocks(replace(blocks, vertices=vertices)).sum()) == 48


def test_where_nothing_is_told_no_block_is_pitched(scene):
    assert not pitched_blocks(scene).any()


@pytest.mark.slow
def test_told_roofs_bring_the_answer_nearer(told, tmp_path):
    """Photos of a town whose every other roof is two metres lower than in the map, which tells which."""
    city_map = CityMap(told, threads=1)
    town = RaisedRoofs(city_map, told, 2.0).at(0)
    each = [replace(FAST, pitched_lower_m=lower_m) for lower_m in (0.0, 2.0)]
    untold, by_what_is_told = mean_errors(city_map, town, each, tmp_path, seeds=(0, 1))
    assert by_what_is_told < 0.9 * untold


def test_the_parameter_is_a_length():
    with pytest.raises(ConfigError, match="pitched_lower_m"):
        RegionParams(pitched_lower_m=-0.1)
