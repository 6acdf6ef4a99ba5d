"""Heading, pitch and roll: against rotated vectors, and back to the rotation as a gimbal's angles."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lodbench.geometry import EulerAngles, Pose, rotation_from_euler, wrap_deg
from lodbench.geometry.angles import (
    STEEP_DEG,
    look_covariance,
    look_from_rotation,
    off_nadir_deg,
    rotation_from_dji,
)

turns = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: 0.1 < np.linalg.norm(q))
angles_deg = st.floats(-180, 180)


def any_rotation(quaternion: tuple[float, ...]) -> np.ndarray:
    return Rotation.from_quat(quaternion).as_matrix()


def slow_look(cam_from_world: np.ndarray) -> tuple[float, float, float]:
    """Returns heading, pitch and roll by the axes' vectors alone: what a hand-held compass would say."""
    right, _, ahead = cam_from_world
    level = np.array([ahead[0], ahead[1], 0.0])
    heading = math.degrees(math.atan2(level @ [1, 0, 0], level @ [0, 1, 0])) % 360.0
    pitch = math.degrees(math.asin(np.clip(ahead[2], -1, 1)))
    level_right = np.cross(ahead, [0.0, 0.0, 1.0])
    level_right /= np.linalg.norm(level_right)
    roll = math.degrees(math.atan2(np.cross(level_right, right) @ ahead, level_right @ right))
    return heading, pitch, roll


def apart_deg(one: np.ndarray, other: np.ndarray) -> float:
    return math.degrees(Rotation.from_matrix(one @ other.T).magnitude())


@given(turns)
def test_off_straight_down_they_are_those_of_the_axes(quaternion):
    rotation = any_rotation(quaternion)
    assume(STEEP_DEG < off_nadir_deg(rotation) < 180.0 - STEEP_DEG)
    found = look_from_rotation(rotation)
    assert 0.0 <= found.heading_deg < 360.0
    assert -90.0 <= found.pitch_deg <= 90.0
    for value, expected in zip(found, slow_look(rotation), strict=True):
        assert abs(wrap_deg(value - expected)) < 1e-6


@given(turns, st.floats(-3.0, 3.0))
def test_as_a_gimbals_angles_they_make_the_same_rotation(quaternion, convergence):
    """Steeper than STEEP_DEG to within a few degrees: there is another meaning of roll."""
    rotation = any_rotation(quaternion)
    assume(off_nadir_deg(rotation) < 180.0 - STEEP_DEG)
    again = rotation_from_dji(*look_from_rotation(rotation, convergence), convergence)
    assert apart_deg(again, rotation) < (1e-6 if off_nadir_deg(rotation) > STEEP_DEG else 1.5 * STEEP_DEG)


def test_a_camera_turned_about_its_axis_keeps_heading_and_pitch():
    """As a kite's: its rows are far from level, and it looks where it looks."""
    found = look_from_rotation(rotation_from_dji(173.8, -63.25, -120.6))
    assert found == pytest.approx((173.8, -63.25, -120.6))


@given(st.floats(-1.4, 1.4), st.floats(-1.4, 1.4), angles_deg)
def test_near_straight_down_the_heading_is_of_the_pictures_top(pitch, roll, yaw):
    rotation = rotation_from_euler(EulerAngles(pitch, roll, yaw))
    assert off_nadir_deg(rotation) < STEEP_DEG
    found = look_from_rotation(rotation)
    top = -rotation[1]
    assert abs(wrap_deg(found.heading_deg - math.degrees(math.atan2(top[0], top[1])))) < 0.05
    assert (found.pitch_deg, found.roll_deg) == pytest.approx((pitch - 90.0, roll))


def test_straight_down_and_straight_up_are_answers_too():
    assert look_from_rotation(rotation_from_dji(30.0, -90.0, 0.0)) == pytest.approx((30.0, -90.0, 0.0))
    assert look_from_rotation(rotation_from_dji(30.0, 90.0, 0.0)) == pytest.approx((30.0, 90.0, 0.0))
    just_past = look_from_rotation(rotation_from_euler(EulerAngles(-179.0, 0.5, -30.0)))
    assert just_past == pytest.approx((30.0, 91.0, 0.5))


@given(st.floats(5.0, 175.0), angles_deg, angles_deg)
def test_the_angle_off_straight_down(tilt, heading, roll):
    assert off_nadir_deg(rotation_from_dji(heading, tilt - 90.0, roll)) == pytest.approx(tilt)


@pytest.mark.parametrize(
    "angles",
    [(30.0, 0.6, 40.0), (62.0, 40.0, -100.0), (14.0, 23.0, -43.0), (1.0, -0.5, 20.0), (179.5, 0.1, 9.0)],
)
def test_standard_deviations_are_those_of_many_draws(angles):
    generator = np.random.default_rng(1)
    root = generator.normal(size=(3, 3)) * 0.01
    covariance = root @ root.T
    draws = generator.multivariate_normal(angles, covariance, size=20000)
    centre = np.array(look_from_rotation(rotation_from_euler(EulerAngles(*angles))))
    looks = np.array([look_from_rotation(rotation_from_euler(EulerAngles(*draw))) for draw in draws])
    spread = np.cov(wrap_deg(looks - centre).T)
    found = look_covariance(rotation_from_euler(EulerAngles(*angles)), covariance)
    np.testing.assert_allclose(found, spread, rtol=0.04, atol=0.02 * np.abs(spread).max())


def test_a_level_roll_does_not_turn_the_axis_of_one_that_looks_level():
    pose = Pose.from_euler(EulerAngles(90.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    found = look_covariance(pose.rotation, np.diag([1.0, 4.0, 9.0]))
    np.testing.assert_allclose(found, np.diag([9.0, 1.0, 4.0]), atol=1e-12)
