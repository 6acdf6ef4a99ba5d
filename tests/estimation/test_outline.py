"""Outlines of a city and their slopes, against finite differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lodbench.estimation.outline_alignment import edges_in_reach, sample_outline
from lodbench.estimation.state_vector import shortened
from lodbench.evaluation import pose_error
from lodbench.geometry.pose import pose_from_vector, rotation_derivatives, turn_per_angle, vector_from_pose
from lodbench.rendering.masks import signed_distance
from tests.town import CAMERA

vectors = st.tuples(
    *[st.floats(-200, 200)] * 3, st.floats(0, 80), st.floats(-10, 10), st.floats(-180, 180)
).map(np.array)


@pytest.mark.filterwarnings("error")
def test_a_step_is_shortened_as_a_whole():
    np.testing.assert_array_equal(shortened(np.zeros(7)), np.zeros(7))
    small, long = np.array([1.0, -2.0, 3.0, 0.5, 0.1, 1.0, 0.2]), np.array([60.0, 0, 1.0, 0, 0, 0, 0])
    np.testing.assert_array_equal(shortened(small), small)
    np.testing.assert_allclose(shortened(long), long / 10.0)


class TestPoseVector:
    @given(vectors)
    def test_there_and_back(self, vector):
        np.testing.assert_allclose(vector_from_pose(pose_from_vector(vector))[:5], vector[:5], atol=1e-8)

    @given(vectors)
    @settings(deadline=None)
    def test_derivatives_are_those_of_finite_differences(self, vector):
        derivatives = rotation_derivatives(vector)
        for k in range(3):
            step = np.zeros(6)
            step[3 + k] = 1e-3
            ahead, behind = (pose_from_vector(vector + sign * step).rotation for sign in (1, -1))
            np.testing.assert_allclose(derivatives[k], (ahead - behind) / 2e-3, atol=1e-8)

    @given(vectors, st.tuples(*[st.floats(-0.05, 0.05)] * 3))
    @settings(deadline=None)
    def test_small_angles_turn_by_what_evaluation_measures(self, vector, angles):
        turned = pose_from_vector(vector + np.array([0, 0, 0, *angles]))
        measured = pose_error(turned, pose_from_vector(vector)).rotation_deg
        assert np.linalg.norm(turn_per_angle(vector) @ angles) == pytest.approx(measured, abs=1e-4)


@pytest.fixture(scope="module")
def seen(scene, city_map, truths):
    pose = truths[0]
    edges = edges_in_reach(scene, CAMERA, pose, 10.0, 5.0)
    silhouette = city_map.render(CAMERA, pose)
    return sample_outline(edges, CAMERA, vector_from_pose(pose), silhouette, 2.0), pose


class TestOutline:
    def test_points_lie_on_the_silhouette_s_outline(self, seen, city_map):
        points, pose = seen
        distance = signed_distance(city_map.render(CAMERA, pose))
        columns, rows = points.pixels.astype(int).T
        assert len(points) > 200
        assert np.abs(distance[rows, columns]).max() < 2.0
        outside = (points.pixels + 1.5 * points.normals).astype(int)
        assert np.mean(distance[outside[:, 1], outside[:, 0]] < 0) > 0.97

    def test_lengths_add_up_to_the_outline(self, seen, city_map):
        points, pose = seen
        mask = city_map.render(CAMERA, pose)
        # Steps between pixels of unlike value, 4/pi of the length on average over directions.
        steps = np.count_nonzero(mask[1:] ^ mask[:-1]) + np.count_nonzero(mask[:, 1:] ^ mask[:, :-1])
        assert points.lengths.sum() == pytest.approx(steps * np.pi / 4, rel=0.12)

    def test_moves_are_those_of_finite_differences(self, seen):
        points, pose = seen
        vector = vector_from_pose(pose)
        depth = 100.0
        rays = np.column_stack(
            [(points.pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(len(points))]
        )
        world = pose.center + depth * rays @ pose.rotation
        for k in range(6):
            step = np.zeros(6)
            step[k] = 1e-4
            ahead, behind = (pose_from_vector(vector + sign * step) for sign in (1, -1))
            pixels = [CAMERA.project(world @ p.rotation.T + p.translation) for p in (ahead, behind)]
            expected = (pixels[0] - pixels[1]) / 2e-4
            if k >= 3:  # Turns move a pixel alike at every depth; shifts by its inverse.
                np.testing.assert_allclose(points.moves[:, k], expected, atol=1e-4)
            else:
                cosines = (
                    (points.moves[:, k] * expected).sum(axis=1)
                    / np.linalg.norm(points.moves[:, k], axis=1)
                    / np.linalg.norm(expected, axis=1)
                )
                np.testing.assert_allclose(cosines, 1.0, atol=1e-6)

    def test_a_longer_lens_moves_points_away_from_the_middle(self, seen):
        points, _ = seen
        expected = 0.01 * (points.pixels - [CAMERA.cx, CAMERA.cy])
        np.testing.assert_allclose(points.moves[:, 6], expected, atol=1e-9)

    def test_roof_and_base_together_lift_a_building_as_the_camera_sinks(self, seen):
        points, _ = seen
        lifted = points.moves[:, 7] + points.moves[:, 8]
        np.testing.assert_allclose(lifted, -points.moves[:, 2], atol=1e-9)

    def test_a_part_of_the_city_gives_what_all_of_it_gives(self, scene, city_map, truths):
        pose, counts = truths[0], []
        for reach_m in (1.0, 1000.0):
            edges = edges_in_reach(scene, CAMERA, pose, reach_m, 1.0)
            silhouette = city_map.render(CAMERA, pose)
            counts.append(sample_outline(edges, CAMERA, vector_from_pose(pose), silhouette, 3.0).pixels)
        np.testing.assert_array_equal(*counts)

    def test_room_grows_with_the_outline(self, scene, city_map, truths):
        pose = truths[0]
        edges = edges_in_reach(scene, CAMERA, pose, 10.0, 5.0)
        silhouette = city_map.render(CAMERA, pose)
        fine = sample_outline(edges, CAMERA, vector_from_pose(pose), silhouette, 0.02)
        assert len(fine) > 1 << 14
        coarse = sample_outline(edges, CAMERA, vector_from_pose(pose), silhouette, 1.0)
        assert fine.lengths.sum() == pytest.approx(coarse.lengths.sum(), rel=0.03)
