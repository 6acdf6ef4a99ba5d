"""Boxes around the buildings of a scene."""

import numpy as np
import pytest

from lodbench.citymodel.scene import Scene, building_boxes

# A roof of three corners, a building that was lost, and another roof.
SCENE = Scene(
    vertices=np.array(
        [[0, 0, 2], [10, 0, 5], [0, 8, 9], [30, 30, 1], [34, 30, 1], [30, 36, 7]], dtype=np.float32
    ),
    triangles=np.arange(6, dtype=np.int32).reshape(2, 3),
    vertex_starts=np.array([0, 3, 3, 6]),
    triangle_starts=np.array([0, 1, 1, 2]),
    building_ids=("a", "lost", "c"),
    lod="1",
    crs=None,
    origin=np.zeros(3),
)


def test_buildings_without_triangles_are_left_out():
    boxes = building_boxes(SCENE)
    np.testing.assert_array_equal(boxes.building, [0, 2])
    np.testing.assert_array_equal(boxes.low, [[0, 0, 2], [30, 30, 1]])
    np.testing.assert_array_equal(boxes.high, [[10, 8, 9], [34, 36, 7]])
    np.testing.assert_array_equal(boxes.bases, [[5, 4, 2], [32, 33, 1]])


@pytest.mark.parametrize(
    ("center", "is_clear"),
    [
        ((5, 4, 6), False),
        ((5, 4, 11.5), True),
        ((11.5, 4, 6), False),
        ((12, 4, 6), True),
        ((32, 33, 8), False),
    ],
)
def test_a_camera_keeps_its_distance_sideways_and_above(center, is_clear):
    assert building_boxes(SCENE).are_clear_of(np.array(center, dtype=float), 2.0) is is_clear
