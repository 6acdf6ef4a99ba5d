"""Heading, pitch and roll: against rotated vectors, and back to the rotation as a gimbal's angles."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lodbench.geometry import (
    EulerAngles,
    Pose,
    euler_from_rotation,
    rotation_from_euler,
    rotations_at_yaws,
    wrap_deg,
)
from lodbench.geometry.angles import (
    STEEP_DEG,
    blender_from_opencv,
    heading_from_yaw,
    look_covariance,
    look_from_rotation,
    off_nadir_deg,
    rotation_from_dji,
    rotations_from_euler,
)

S = np.diag([1.0, -1.0, -1.0])
angles_deg = st.floats(-180, 180)
rolls_deg = st.floats(-89, 89)


def scipy_rotation(pitch: float, roll: float, yaw: float) -> np.ndarray:
    """Returns cam_from_world of the datasets' angles, by SciPy's extrinsic xyz."""
    return (Rotation.from_euler("xyz", [pitch, roll, yaw], degrees=True).as_matrix() @ S).T


class TestWrap:
    @pytest.mark.parametrize(
        ("angle", "wrapped"),
        [(0, 0), (180, -180), (-180, -180), (540, -180), (359, -1), (-190, 170), (720.5, 0.5)],
    )
    def test_values(self, angle, wrapped):
        assert wrap_deg(angle) == wrapped

    @given(st.floats(-1e5, 1e5), st.integers(-50, 50))
    def test_range_and_period(self, angle, turns):
        wrapped = wrap_deg(angle)
        assert -180 <= wrapped < 180
        # The seam at 180 may fall either way by rounding.
        difference = abs(wrap_deg(angle + 360.0 * turns) - wrapped)
        assert min(difference, 360 - difference) < 1e-9

    def test_nan_stays_nan(self):
        assert math.isnan(wrap_deg(math.nan))


class TestDatasetAngles:
    def test_looking_straight_down_with_north_up(self):
        np.testing.assert_allclose(rotation_from_euler(EulerAngles(0, 0, 0)), S, atol=1e-15)

    @pytest.mark.parametrize(
        ("yaw", "looks_at"), [(0, (0, 1, 0)), (90, (-1, 0, 0)), (-90, (1, 0, 0)), (180, (0, -1, 0))]
    )
    def test_at_the_horizon_yaw_turns_counter_clockwise_from_north(self, yaw, looks_at):
        rotation = rotation_from_euler(EulerAngles(90, 0, yaw))
        np.testing.assert_allclose(rotation[2], looks_at, atol=1e-15)
        np.testing.assert_allclose(rotation[1], (0, 0, -1), atol=1e-15)

    @given(angles_deg, rolls_deg, angles_deg)
    def test_against_scipy(self, pitch, roll, yaw):
        rotation = rotation_from_euler(EulerAngles(pitch, roll, yaw))
        np.testing.assert_allclose(rotation, scipy_rotation(pitch, roll, yaw), atol=1e-14)
        expected = Rotation.from_matrix(rotation.T @ S).as_euler("xyz", degrees=True)
        for found, wanted in zip(euler_from_rotation(rotation), expected, strict=True):
            assert abs(wrap_deg(found - wanted)) < 1e-6

    @given(angles_deg, rolls_deg, angles_deg)
    def test_there_and_back(self, pitch, roll, yaw):
        found = euler_from_rotation(rotation_from_euler(EulerAngles(pitch, roll, yaw)))
        for value, wanted in zip(found, (pitch, roll, yaw), strict=True):
            assert abs(wrap_deg(value - wanted)) < 1e-9

    @given(angles_deg, rolls_deg, st.lists(angles_deg, min_size=1, max_size=5))
    def test_many_yaws_of_one_tilt(self, pitch, roll, yaws):
        rotations = rotations_at_yaws(pitch, roll, np.array(yaws))
        assert rotations.shape == (len(yaws), 3, 3)
        for rotation, yaw in zip(rotations, yaws, strict=True):
            np.testing.assert_allclose(rotation, scipy_rotation(pitch, roll, yaw), atol=1e-14)

    def test_the_right_side_dips_by_roll_and_points_yaw_from_east(self):
        right, _, ahead = rotation_from_euler(EulerAngles(60.0, 10.0, 30.0))
        assert math.degrees(math.asin(-right[2])) == pytest.approx(10.0)
        assert math.degrees(math.atan2(right[1], right[0])) == pytest.approx(30.0)
        # Roll is about the level axis ahead, so the view leaves yaw.
        assert math.degrees(math.atan2(-ahead[0], ahead[1])) == pytest.approx(35.73, abs=0.01)

    def test_no_yaws_give_no_rotations(self):
        assert rotations_at_yaws(10.0, 0.0, np.zeros(0)).shape == (0, 3, 3)

    @given(st.lists(st.tuples(angles_deg, rolls_deg, angles_deg), max_size=4))
    def test_of_many_angles_is_that_of_each(self, angles):
        alone = np.array([rotation_from_euler(EulerAngles(*each)) for each in angles]).reshape(-1, 3, 3)
        np.testing.assert_allclose(rotations_from_euler(np.reshape(angles, (-1, 3))), alone, atol=1e-14)


class TestDji:
    def test_the_demo_gimbal_is_the_demo_prior(self):
        found = euler_from_rotation(rotation_from_dji(-43.6, -45.3, 0.0))
        np.testing.assert_allclose(found, (44.7, 0.0, 43.6), atol=1e-12)

    def test_level_gimbal_to_the_north_looks_north(self):
        rotation = rotation_from_dji(0, 0, 0)
        np.testing.assert_allclose(rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)

    def test_positive_yaw_is_clockwise(self):
        np.testing.assert_allclose(rotation_from_dji(90, 0, 0)[2], (1, 0, 0), atol=1e-15)

    @given(st.floats(-180, 180), st.floats(-120, 30), st.floats(-30, 30))
    def test_against_scipy_turns_in_north_east_down(self, yaw, pitch, roll):
        ned = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
        right, down, forward = ned[:, 1], ned[:, 2], ned[:, 0]
        enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
        expected = np.stack([enu @ right, enu @ down, enu @ forward])
        np.testing.assert_allclose(rotation_from_dji(yaw, pitch, roll), expected, atol=1e-14)

    @given(st.floats(-180, 180), st.floats(-89, 0), st.floats(-20, 20))
    def test_roll_turns_about_the_optical_axis(self, yaw, pitch, roll):
        level, rolled = rotation_from_dji(yaw, pitch, 0), rotation_from_dji(yaw, pitch, roll)
        np.testing.assert_allclose(level[2], rolled[2], atol=1e-14)
        assert level[0] @ rolled[0] == pytest.approx(math.cos(math.radians(roll)), abs=1e-12)

    def test_convergence_turns_true_into_grid_north(self):
        np.testing.assert_allclose(
            rotation_from_dji(30, -40, 1, 0.5), rotation_from_dji(29.5, -40, 1), atol=1e-15
        )


class TestOtherConventions:
    @given(angles_deg, rolls_deg, angles_deg, st.tuples(*[st.floats(-1e3, 1e3)] * 3))
    def test_blender_keeps_x_and_the_centre_and_is_its_own_inverse(self, pitch, roll, yaw, center):
        matrix = np.eye(4)
        matrix[:3, :3] = scipy_rotation(pitch, roll, yaw).T
        matrix[:3, 3] = center
        blender = blender_from_opencv(matrix)
        np.testing.assert_array_equal(blender[:, 0], matrix[:, 0])
        np.testing.assert_array_equal(blender[:, 1:3], -matrix[:, 1:3])
        np.testing.assert_array_equal(blender[:, 3], matrix[:, 3])
        np.testing.assert_array_equal(blender_from_opencv(blender), matrix)
        found = Rotation.from_matrix(blender[:3, :3]).as_euler("xyz", degrees=True)
        for value, wanted in zip(found, (pitch, roll, yaw), strict=True):
            assert abs(wrap_deg(value - wanted)) < 1e-6

    @pytest.mark.parametrize(("yaw", "heading"), [(0, 0), (-90, 90), (90, 270), (180, 180), (-360, 0)])
    def test_headings_run_clockwise(self, yaw, heading):
        assert heading_from_yaw(yaw) == heading


turns = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: 0.1 < np.linalg.norm(q))


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
