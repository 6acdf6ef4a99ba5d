""""""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lodbench.errors import LodbenchError
from lodbench.geometry import AxisRange, EulerAngles, Pose, PoseGrid, wrap_deg
from lodbench.geometry.pose import quaternion_from_rotation, rotation_from_quaternion

numbers = st.floats(-1e4, 1e4)
points = st.tuples(numbers, numbers, numbers)


@st.composite
def quaternions(draw):
    """Draws unit quaternions (w, x, y, z), half turns and near-zero parts included."""
    parts = np.array(draw(st.tuples(*[st.sampled_from([0.0, 1.0, -1.0, 1e-9]) | st.floats(-1, 1)] * 4)))
    norm = np.linalg.norm(parts)
    return tuple(parts / norm) if norm > 1e-3 else (1.0, 0.0, 0.0, 0.0)


class TestQuaternions:
    @given(quaternions())
    def test_to_rotation_against_scipy(self, q):
        expected = Rotation.from_quat(np.roll(q, -1)).as_matrix()
        np.testing.assert_allclose(rotation_from_quaternion(q), expected, atol=1e-14)

    @given(quaternions())
    def test_there_and_back_up_to_sign(self, q):
        found = np.array(quaternion_from_rotation(rotation_from_quaternion(q)))
        assert found[0] >= 0
        assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-15)
        assert min(np.abs(found - q).max(), np.abs(found + q).max()) < 1e-12

    def test_a_slightly_long_quaternion_is_normalised(self):
        rotation = rotation_from_quaternion([1.0005, 0, 0, 0])
        np.testing.assert_array_equal(rotation, np.eye(3))

    @pytest.mark.parametrize("q", [(1.01, 0, 0, 0), (0, 0, 0, 0), (math.nan, 0, 0, 1), (math.inf, 0, 0, 0)])
    def test_another_length_is_refused(self, q):
        with pytest.raises(LodbenchError, match=r"length|finite"):
            rotation_from_quaternion(q)


class TestPose:
    @given(quaternions(), points)
    def test_matrices_are_each_others_inverse(self, q, t):
        pose = Pose.from_quaternion(q, t)
        np.testing.assert_allclose(pose.cam_from_world @ pose.world_from_cam, np.eye(4), atol=1e-9)
        np.testing.assert_allclose(pose.world_from_cam[:3, 3], pose.center)

    @given(quaternions(), points)
    def test_the_centre_is_where_camera_coordinates_vanish(self, q, center):
        pose = Pose.from_center(rotation_from_quaternion(q), center)
        np.testing.assert_allclose(pose.rotation @ np.array(center) + pose.translation, 0, atol=1e-9)
        np.testing.assert_allclose(pose.center, center, atol=1e-9)

    @given(quaternions(), points)
    def test_matrix_there_and_back(self, q, t):
        pose = Pose.from_quaternion(q, t)
        again = Pose.from_matrix(pose.cam_from_world)
        np.testing.assert_array_equal(again.cam_from_world, pose.cam_from_world)
        np.testing.assert_array_equal(Pose.from_matrix(pose.cam_from_world[:3]).rotation, pose.rotation)

    @given(quaternions(), points, points)
    def test_shifting_moves_the_centre_alone(self, q, t, offset):
        pose = Pose.from_quaternion(q, t)
        moved = pose.shifted(offset)
        np.testing.assert_array_equal(moved.rotation, pose.rotation)
        np.testing.assert_allclose(moved.center, pose.center + offset, atol=1e-8)

    @given(st.floats(5, 85), st.floats(-20, 20), st.floats(-179, 179), st.floats(0, 90), st.floats(-20, 20))
    def test_tilt_of_another_keeps_yaw_and_centre(self, pitch, roll, yaw, other_pitch, other_roll):
        pose = Pose.from_euler(EulerAngles(pitch, roll, yaw), (1, 2, 3))
        other = Pose.from_euler(EulerAngles(other_pitch, other_roll, 77.0), (9, 9, 9))
        mixed = pose.with_tilt_of(other)
        np.testing.assert_allclose(mixed.center, (1, 2, 3), atol=1e-12)
        np.testing.assert_allclose(mixed.euler[:2], (other_pitch, other_roll), atol=1e-9)
        assert abs(wrap_deg(mixed.euler.yaw_deg - yaw)) < 1e-9

    def test_a_mirrored_matrix_is_refused(self):
        with pytest.raises(LodbenchError, match="no rotation"):
            Pose.from_matrix(np.diag([1.0, 1.0, -1.0, 1.0]))

    @pytest.mark.parametrize("value", [math.nan, math.inf])
    def test_a_matrix_that_is_not_finite_is_refused(self, value):
        matrix = np.eye(4)
        matrix[0, 3] = value
        with pytest.raises(LodbenchError, match="finite"):
            Pose.from_matrix(matrix)

    def test_a_scaled_matrix_is_refused(self):
        with pytest.raises(LodbenchError, match="no rotation"):
            Pose.from_matrix(np.diag([2.0, 2.0, 2.0, 1.0]))

    @pytest.mark.parametrize(
        "rotation", [2.0 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan)]
    )
    def test_what_is_no_rotation_stands_at_no_place(self, rotation):
        with pytest.raises(LodbenchError, match="no rotation"):
            Pose.from_center(rotation, (1, 2, 3))

    @pytest.mark.parametrize("angles", [(math.nan, 0, 0), (0, math.inf, 0), (0, 0, math.nan)])
    def test_angles_that_are_not_finite_are_refused(self, angles):
        with pytest.raises(LodbenchError, match="not finite"):
            Pose.from_euler(EulerAngles(*angles), (1, 2, 3))

    @pytest.mark.parametrize("place", [(1, 2), 5, np.eye(3)])
    def test_a_place_is_three_numbers(self, place):
        for make in (
            lambda: Pose.from_euler(EulerAngles(0, 0, 0), place),
            lambda: Pose.from_center(np.eye(3), place),
            lambda: Pose.from_center(np.eye(3), (1, 2, 3)).shifted(place),
        ):
            with pytest.raises(LodbenchError, match="holds east, north and up"):
                make()

    def test_matrices_of_another_shape_are_refused(self):
        with pytest.raises(LodbenchError, match=r"not \(3, 3\)"):
            Pose.from_matrix(np.eye(3))
        with pytest.raises(LodbenchError, match=r"not \(4, 4\)"):
            Pose.from_center(np.eye(4), (1, 2, 3))


PRIOR = Pose.from_euler(EulerAngles(40.0, 1.0, 30.0), (100.0, 200.0, 150.0))


class TestAxis:
    def test_ends_are_included(self):
        np.testing.assert_allclose(AxisRange(60.0, 7).offsets(), [-30, -20, -10, 0, 10, 20, 30])

    def test_one_sample_is_the_centre(self):
        assert AxisRange(60.0, 1).offsets().tolist() == [0.0]

    @given(st.floats(0, 1e3), st.integers(2, 50))
    def test_spans_the_width_evenly(self, width, count):
        offsets = AxisRange(width, count).offsets()
        assert len(offsets) == count
        np.testing.assert_allclose(offsets, np.linspace(-width / 2, width / 2, count), atol=1e-9)

    @pytest.mark.parametrize(("width", "count"), [(10, 0), (-1, 3), (math.nan, 3)])
    def test_nonsense_is_refused(self, width, count):
        with pytest.raises(LodbenchError, match="grid axis"):
            AxisRange(width, count)


def test_order_is_yaw_x_y_z_with_z_fastest():
    grid = PoseGrid(AxisRange(20, 3), AxisRange(40, 2), AxisRange(60, 2), AxisRange(15, 2))
    centers, yaws = grid.around(PRIOR)
    assert len(grid) == len(centers) == len(yaws) == 24
    expected = [
        (30 + dyaw, 100 + dx, 200 + dy, 150 + dz)
        for dyaw in (-7.5, 7.5)
        for dx in (-10, 0, 10)
        for dy in (-20, 20)
        for dz in (-30, 30)
    ]
    np.testing.assert_allclose(np.column_stack([yaws, centers]), expected, atol=1e-9)


def test_a_grid_of_one_is_the_prior():
    one = AxisRange(0.0, 1)
    centers, yaws = PoseGrid(one, one, one, one).around(PRIOR)
    np.testing.assert_array_equal(centers, [PRIOR.center])
    assert yaws.tolist() == [PRIOR.euler.yaw_deg]
