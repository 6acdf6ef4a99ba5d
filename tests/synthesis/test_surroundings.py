"""What stands around a city that says nothing about it."""

from dataclasses import replace

import numpy as np
import pytest

from lodbench.citymodel.scene import building_boxes
from lodbench.errors import DatasetError
from lodbench.kernels.looks import SurfaceClass
from lodbench.storage import random_stream
from lodbench.synthesis.land_cover import Ground
from lodbench.synthesis.objects import MeshBuilder
from lodbench.synthesis.surroundings import CLUTTER, Spot, make_surroundings, standing_clutter

SLOPE = Ground(-100.0, -100.0, 10.0, np.fromfunction(lambda row, column: 2.0 * column, (21, 21)))


@pytest.fixture(scope="module")
def made(city):
    return make_surroundings(city, seed=3)


def corners_of(props, *kinds):
    chosen = np.isin(props.surface, kinds)
    return props.vertices[props.triangles[chosen]].astype(float)


def test_trees_cars_and_clutter_keep_clear_of_buildings(made, city):
    boxes = building_boxes(city)
    for kind in (SurfaceClass.TRUNK, SurfaceClass.CAR_BODY, SurfaceClass.CLUTTER):
        points = corners_of(made[0], kind).reshape(-1, 3)
        assert len(points) > 30
        inside = (points[:, None, :2] > boxes.low[:, :2] + 0.5) & (
            points[:, None, :2] < boxes.high[:, :2] - 0.5
        )
        assert not inside.all(axis=2).any(), kind


def test_what_stands_beside_buildings_is_boxed_and_what_is_painted_is_not(made, city):
    props, land = made
    boxes = np.array(standing_clutter(props, land)) - np.tile(props.origin[:2], 2)
    containers = corners_of(props, SurfaceClass.CLUTTER).mean(axis=1)
    inside = ((containers[:, None, :2] >= boxes[:, :2]) & (containers[:, None, :2] <= boxes[:, 2:])).all(
        axis=2
    )
    assert inside.any(axis=1).all()
    heaps = (props.surface == SurfaceClass.GROUND) & props.tint.any(axis=1)
    assert len(np.unique(props.objects[heaps | (props.surface == SurfaceClass.CLUTTER)])) >= len(boxes) > 5
    # A yard is wider than anything that stands.
    assert (boxes[:, 2:] - boxes[:, :2]).max() < 18.0


def test_a_city_with_a_house_at_zero_gets_no_land(city):
    """Memory was asked for by the hundred gigabytes."""
    vertices = city.vertices.copy()
    vertices[:8] += np.float32(5e6)
    with pytest.raises(DatasetError, match=r"5,000 km wide: land is made up for at most 60 km"):
        make_surroundings(replace(city, vertices=vertices), seed=3)


def test_everything_stands_on_the_ground(made):
    # Trunks are rooted.
    for kind, lowest_m, highest_m in ((SurfaceClass.CAR_BODY, -0.5, 2.2), (SurfaceClass.TRUNK, -3.0, 12.0)):
        points = corners_of(made[0], kind).reshape(-1, 3)
        above = points[:, 2] - made[1].ground.at(points)
        assert above.min() > lowest_m
        assert above.max() < highest_m


def test_the_same_seed_makes_the_same_and_another_something_else(made, city):
    again, other = make_surroundings(city, seed=3), make_surroundings(city, seed=4)
    np.testing.assert_array_equal(again[0].vertices, made[0].vertices)
    np.testing.assert_array_equal(again[1].cover.classes, made[1].cover.classes)
    assert len(other[0].vertices) != len(made[0].vertices)


def test_ground_is_interpolated_and_flat_beyond_its_rim():
    found = SLOPE.at(np.array([[-100.0, 0.0], [-95.0, 3.0], [50.0, 50.0], [400.0, 0.0]]))
    np.testing.assert_allclose(found, [0.0, 1.0, 30.0, 40.0])


@pytest.mark.parametrize("kind", CLUTTER)
def test_clutter_stays_in_its_circle_on_the_slope(kind):
    add, radius_m = CLUTTER[kind]
    for draw in range(4):
        builder = MeshBuilder(0)
        spot = Spot(np.array([5.0, -8.0]), np.array([0.6, 0.8]), SLOPE)
        add(builder, spot, random_stream(draw, kind))
        props = builder.build(np.zeros(3))
        points = props.vertices.astype(float)
        assert len(points) > 3
        assert np.linalg.norm(points[:, :2] - spot.middle, axis=1).max() < radius_m
        above = points[:, 2] - SLOPE.at(points)
        assert above.min() > -4.0
        assert above.max() < 9.0
        kinds = [SurfaceClass(kind) for kind in set(props.surface.tolist())]
        assert all(kind.is_ground or kind >= SurfaceClass.TRUNK for kind in kinds)
