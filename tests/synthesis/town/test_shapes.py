from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.synthesis.town import shapes

RECTANGLE = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 20.0], [0.0, 20.0]])


def test_area_and_angles():
    assert shapes.area(RECTANGLE) == 600.0
    assert shapes.area(RECTANGLE[::-1]) == -600.0
    np.testing.assert_allclose(shapes.corner_angles_deg(RECTANGLE), 90.0)


def test_inset_moves_every_edge():
    inner = shapes.inset(RECTANGLE, 4.0)
    assert inner is not None
    np.testing.assert_allclose(inner, [[4, 4], [26, 4], [26, 16], [4, 16]])
    assert shapes.inset(RECTANGLE, 10.0) is None


def test_cut_keeps_the_inward_side():
    part = shapes.cut(RECTANGLE, np.array([10.0, 0.0]), np.array([1.0, 0.0]))
    assert shapes.area(part) == pytest.approx(400.0)
    assert len(shapes.cut(RECTANGLE, np.array([40.0, 0.0]), np.array([1.0, 0.0]))) == 0


def test_contains_handles_notches():
    notched = np.array([[0, 0], [10, 0], [10, 10], [5, 4], [0, 10]], dtype=float)
    inside = shapes.contains(notched, np.array([[5.0, 2.0], [5.0, 8.0], [1.0, 8.0], [11.0, 1.0]]))
    np.testing.assert_array_equal(inside, [True, False, True, False])


@given(st.floats(-40, 40), st.floats(-40, 40), st.floats(0, 180))
def test_keeps_apart_agrees_with_the_overlap(x, y, angle):
    other = cv2.boxPoints(((x, y), (18.0, 9.0), angle)).astype(float)
    other = other if shapes.area(other) > 0 else other[::-1]
    clipped = RECTANGLE
    for corner, left in zip(other, shapes.left_of(shapes.edge_directions(other)), strict=True):
        clipped = shapes.cut(clipped, corner, left)
    overlap = shapes.area(clipped) if len(clipped) > 2 else 0.0
    if shapes.keeps_apart(RECTANGLE, other, 0.0):
        assert overlap < 1e-6
    else:
        assert overlap > 0.0


def test_touching_walls_are_apart_but_leave_no_gap():
    neighbour = RECTANGLE + np.array([30.0, 0.0])
    assert shapes.keeps_apart(RECTANGLE, neighbour, 0.0)
    assert not shapes.keeps_apart(RECTANGLE, neighbour, 0.5)


def test_box_of_follows_the_longer_side():
    turn = np.radians(25.0)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    along, length, width = shapes.box_of(RECTANGLE @ rotation)
    assert (length, width) == (pytest.approx(30.0), pytest.approx(20.0))
    assert abs(along @ np.array([np.cos(turn), np.sin(turn)])) == pytest.approx(1.0)
