import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lodbench.evaluation import pose_error
from lodbench.evaluation.errors import FAILED
from lodbench.geometry import EulerAngles, Pose

angles = st.tuples(st.floats(-180, 180), st.floats(-89, 89), st.floats(-180, 180))
points = st.tuples(*[st.floats(-1e3, 1e3)] * 3)


def pose_of(euler, center=(0.0, 0.0, 0.0)) -> Pose:
    return Pose.from_euler(EulerAngles(*euler), center)


@given(angles, angles, points, points)
def test_against_scipy(a, b, center_a, center_b):
    estimate, truth = pose_of(a, center_a), pose_of(b, center_b)
    error = pose_error(estimate, truth)
    turn = Rotation.from_matrix(estimate.rotation) * Rotation.from_matrix(truth.rotation).inv()
    assert error.rotation_deg == pytest.approx(math.degrees(turn.magnitude()), abs=1e-6)
    assert error.translation_m == pytest.approx(math.dist(center_a, center_b), abs=1e-9)


@given(angles, angles)
def test_against_the_textbook_arccos(a, b):
    estimate, truth = pose_of(a), pose_of(b)
    cosine = (np.trace(truth.rotation.T @ estimate.rotation) - 1) / 2
    expected = math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
    # arccos loses half the digits near 0 and 180 degrees.
    assert pose_error(estimate, truth).rotation_deg == pytest.approx(expected, abs=2e-5)


@given(angles, angles, points)
def test_is_symmetric_and_within_half_a_turn(a, b, center):
    one, two = pose_of(a, center), pose_of(b)
    forth, back = pose_error(one, two), pose_error(two, one)
    assert forth == pytest.approx(back, abs=1e-9)
    assert 0 <= forth.rotation_deg <= 180


@given(angles, points)
def test_a_pose_has_no_error_against_itself(a, center):
    error = pose_error(pose_of(a, center), pose_of(a, center))
    assert error.translation_m == 0
    assert error.rotation_deg < 1e-13


@pytest.mark.parametrize("turn_deg", [1e-9, 1e-6, 1e-3, 1.0, 90.0, 179.999, 180.0])
def test_tiny_and_half_turns_keep_their_digits(turn_deg):
    truth = pose_of((40.0, 0.0, 0.0))
    error = pose_error(pose_of((40.0, 0.0, turn_deg)), truth)
    assert error.rotation_deg == pytest.approx(turn_deg, rel=1e-6)


@given(st.floats(-170, 170), st.integers(-3, 3))
def test_whole_turns_of_yaw_do_not_count(yaw, turns):
    error = pose_error(pose_of((40, 1, yaw + 360 * turns)), pose_of((40, 1, yaw)))
    assert error.rotation_deg < 1e-9


def test_the_centres_are_compared_not_the_translations():
    turned = pose_of((40.0, 0.0, 90.0), (500.0, 600.0, 150.0))
    truth = pose_of((40.0, 0.0, 0.0), (500.0, 600.0, 153.0))
    assert pose_error(turned, truth).translation_m == pytest.approx(3.0)


def test_no_answer_is_infinitely_far_and_half_a_turn_off():
    assert FAILED == (math.inf, 180.0)
