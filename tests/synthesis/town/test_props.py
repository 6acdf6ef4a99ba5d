from __future__ import annotations

import numpy as np
import pytest
from solid_checks import volume_m3

from lodbench.kernels.looks import SurfaceClass
from lodbench.synthesis.town.ground import filled, refined
from lodbench.synthesis.town.props import demo_props
from lodbench.synthesis.town.town import ORIGIN_M


@pytest.fixture(scope="module")
def props(town):
    return demo_props(town)


def corners_of(props, *kinds):
    chosen = np.isin(props.surface, kinds)
    return props.vertices[props.triangles[chosen]].astype(float)


@pytest.mark.slow
def test_every_class_is_there_and_indices_hold(props, town):
    assert set(np.unique(props.surface)) == set(SurfaceClass) - {SurfaceClass.CLUTTER}
    assert props.triangles.min() == 0
    assert props.triangles.max() == len(props.vertices) - 1
    assert np.isfinite(props.vertices).all()
    assert props.has_buildings
    assert props.num_buildings == len(town.standing)
    is_building = (props.surface >= SurfaceClass.WALL) & (props.surface < SurfaceClass.TRUNK)
    np.testing.assert_array_equal(props.objects < props.num_buildings, is_building)
    np.testing.assert_array_equal(props.origin, ORIGIN_M)


def test_buildings_are_those_of_the_town(props, town):
    for number in (0, 40, 300):
        solid = town.standing[number].lod3
        mine = (props.objects == number) & np.isin(props.surface, (20, 21, 22, 23, 24, 27))
        corners = props.vertices[props.triangles[mine]].astype(float)
        middle = corners.reshape(-1, 3).mean(axis=0)
        crossed = np.cross(corners[:, 0] - middle, corners[:, 1] - middle)
        volume = np.sum(crossed * (corners[:, 2] - middle)) / 6.0
        assert volume == pytest.approx(volume_m3(solid), rel=1e-3)


def test_ground_faces_up_and_lies_on_the_terrain(props, town):
    for kind in (SurfaceClass.ROAD, SurfaceClass.MARKING, SurfaceClass.PAVEMENT, SurfaceClass.GRASS):
        corners = corners_of(props, kind)[::7]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        middle = corners.mean(axis=1)
        above = middle[:, 2] - town.terrain.height(middle[:, :2])
        # Bridges and their parapets are off the ground.
        dry = town.terrain.river_distance(middle[:, :2]) > 45.0
        assert (normal[dry, 2] > 0).all(), kind
        assert np.abs(above[dry]).max() < 0.3, kind


def test_layers_of_the_ground_stay_in_order(town):
    # The road under a block and the pavement on it are two meshes of one hill.
    block = town.streets.blocks[3].ring
    points, triangles = refined(*filled(block), lambda middles: np.full(len(middles), 12.0))
    middles = town.terrain.on_ground(points, 0.12)[triangles].mean(axis=1)
    assert (middles[:, 2] > town.terrain.height(middles[:, :2]) + 0.05).all()


def test_trees_stand_clear_of_buildings_and_cars_on_roads(props, town):
    trunks = corners_of(props, SurfaceClass.TRUNK).mean(axis=1)
    assert (town.occupancy.at(trunks[:, :2]) == 0).all()
    cars = corners_of(props, SurfaceClass.CAR_BODY).mean(axis=1)
    assert np.mean(town.occupancy.at(cars[:, :2]) == 0) > 0.999
    above = cars[:, 2] - town.terrain.height(cars[:, :2])
    assert above.min() > -0.2
    assert above.max() < 2.2
    leaves = corners_of(props, SurfaceClass.FOLIAGE)
    assert (leaves.mean(axis=1)[:, 2] > town.terrain.height(leaves.mean(axis=1)[:, :2])).mean() > 0.99


@pytest.mark.slow
def test_the_same_town_has_the_same_props(props, town):
    again = demo_props(town)
    np.testing.assert_array_equal(again.vertices, props.vertices)
    np.testing.assert_array_equal(again.triangles, props.triangles)
    np.testing.assert_array_equal(again.tint, props.tint)


def test_refining_leaves_no_cracks_and_no_area_behind():
    ring = np.array([[0.0, 0.0], [90.0, 5.0], [100.0, 70.0], [40.0, 95.0], [30.0, 40.0]])
    points, triangles = refined(*filled(ring), lambda middles: 4.0 + 0.2 * np.abs(middles[:, 0]))
    a, b, c = (points[triangles[:, k]] for k in range(3))
    double = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    x, y = ring.T
    expected = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    assert (double > 0).all()
    assert 0.5 * double.sum() == pytest.approx(expected)
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    assert counts.max() == 2
    # An edge with one triangle lies on the outline: a crack would be inside.
    border = points[unique[counts == 1]]
    assert np.linalg.norm(border[:, 1] - border[:, 0], axis=1).sum() == pytest.approx(
        np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).sum()
    )
