"""Six degrees of freedom: slopes against finite differences, poses found, the answer's certainty."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from lodbench.citymap import CityMap
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.methods.contour_alignment import ContourAlignment, Params
from lodbench.methods.contour_alignment.alignment import Aligner, Residuals, _distance, signed_distance
from lodbench.methods.contour_alignment.likelihood import _weights, deal_out
from lodbench.methods.contour_alignment.outline import OutlinePoints, edges_in_reach, sample_outline
from lodbench.methods.contour_alignment.pose_vector import (
    pose_from_vector,
    rotation_derivatives,
    turn_per_angle,
    vector_from_pose,
)
from lodbench.methods.contour_alignment.refinement import Mode, Refined
from lodbench.methods.contour_alignment.uncertainty import answer_of, probability_within
from lodbench.methods.contour_alignment.world_errors import TRACKS
from lodbench.methods.measured_calls import localize_query
from lodbench.storage import random_stream
from tests.town import CAMERA

STREAMS = partial(random_stream, 0, "test")
# Masks and map are exact: half a pixel of noise is more than they have, and no roof is wrong.
SMALL = Params(coarse_size=(160, 120), fine_size=(320, 240), noise_px=0.5, roof_m=0.0)

vectors = st.tuples(
    *[st.floats(-200, 200)] * 3, st.floats(0, 80), st.floats(-10, 10), st.floats(-180, 180)
).map(np.array)


def tilted(pose: Pose, offset: tuple[float, ...]) -> Pose:
    """Returns a pose off by metres and by degrees of pitch, roll and yaw."""
    return pose_from_vector(vector_from_pose(pose) + np.array(offset))


@pytest.fixture(scope="module")
def tilted_queries(city_map, truths):
    offsets = [(5, -4, 9, 0.8, -0.7, 3), (-6, 3, -12, -0.9, 0.4, -4), (2, 6, 15, 0.5, 0.9, 5)]
    return [
        Query(f"q{i}", "all", CAMERA, tilted(pose, offset), city_map.render(CAMERA, pose).astype(np.float32))
        for i, (pose, offset) in enumerate(zip(truths, offsets, strict=True))
    ]


@pytest.fixture(scope="module")
def estimates(tilted_queries, city_map):
    return [ContourAlignment(SMALL).localize(query, city_map, STREAMS) for query in tilted_queries]


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
    derivatives = rotation_derivatives(vector_from_pose(pose))
    return sample_outline(edges, CAMERA, pose, derivatives, city_map.render(CAMERA, pose), 2.0), pose


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
        pose = truths[0]
        derivatives = rotation_derivatives(vector_from_pose(pose))
        counts = []
        for reach_m in (1.0, 1000.0):
            edges = edges_in_reach(scene, CAMERA, pose, reach_m, 1.0)
            silhouette = city_map.render(CAMERA, pose)
            counts.append(sample_outline(edges, CAMERA, pose, derivatives, silhouette, 3.0).pixels)
        np.testing.assert_array_equal(*counts)

    def test_room_grows_with_the_outline(self, scene, city_map, truths):
        pose = truths[0]
        edges = edges_in_reach(scene, CAMERA, pose, 10.0, 5.0)
        derivatives, silhouette = rotation_derivatives(vector_from_pose(pose)), city_map.render(CAMERA, pose)
        fine = sample_outline(edges, CAMERA, pose, derivatives, silhouette, 0.02)
        assert len(fine) > 1 << 14
        coarse = sample_outline(edges, CAMERA, pose, derivatives, silhouette, 1.0)
        assert fine.lengths.sum() == pytest.approx(coarse.lengths.sum(), rel=0.03)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_distances_are_exact_whatever_the_threads(threads):
    mask = np.random.default_rng(0).random((301, 402)) > 0.02
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    found = _distance(mask)
    cv2.setNumThreads(before)
    assert np.array_equal(found, distance_transform_edt(mask).astype(np.float32))


class TestAlignment:
    def test_the_gradient_vanishes_where_it_ends(self, tilted_queries, city_map):
        query = tilted_queries[0]
        aligner = Aligner(query, city_map, SMALL)
        start = np.append(vector_from_pose(query.prior), 0.0)
        vector = aligner.align(start, (24.0, 16.0, 12.0, 8.0, 6.0, 4.0, 3.0, 3.0, 3.0, 3.0), (320, 240))
        step = np.linalg.solve(
            *[getattr(aligner.linearize(vector, 3.0, (320, 240)), n) for n in ("information", "gradient")]
        )
        assert np.linalg.norm(step[:3]) < 0.2
        assert np.linalg.norm(step[3:]) < 0.05

    def test_an_empty_view_is_no_information(self, tilted_queries, city_map):
        aligner = Aligner(tilted_queries[0], city_map, SMALL)
        away = np.append(vector_from_pose(tilted_queries[0].prior.shifted([5000, 0, 0])), 0.0)
        assert aligner.linearize(away, 3.0, (320, 240)) is None

    @pytest.mark.parametrize("value", [True, False])
    def test_a_mask_of_one_value_has_no_outline_anywhere(self, value):
        distance = signed_distance(np.full((4, 6), value))
        assert (np.abs(distance) == 10).all()
        assert (distance > 0).all() == value

    @pytest.mark.parametrize("slope", [0.1, 0.37, 0.5, 1.0, 3.0])
    def test_stairs_of_a_slanted_edge_do_not_lean(self, slope):
        """Near an edge whose pixels go up in stairs, distances are those to the line."""
        y, x = np.mgrid[0:160, 0:200].astype(float)
        exact = (y - 60.3 - slope * (x - 100)) / np.hypot(1.0, slope)
        near = (np.abs(exact) < 1) & (np.minimum(x, y) > 12) & (x < 188) & (y < 148)
        inside, outside = (
            cv2.distanceTransform(side.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            for side in (exact > 0, exact <= 0)
        )
        stairs = inside - outside + np.where(exact > 0, -0.5, 0.5)
        errors = [
            np.sqrt(np.mean((found - exact)[near] ** 2)) for found in (signed_distance(exact > 0), stairs)
        ]
        assert errors[0] < 0.22
        assert errors[0] < 0.8 * errors[1]

    def test_a_wrong_height_of_a_roof_is_told_from_a_wrong_pose(self, tilted_queries, city_map, truths):
        query = tilted_queries[0]
        informed = [
            Aligner(query, city_map, replace(SMALL, roof_m=roof_m)).linearize(
                np.append(vector_from_pose(truths[0]), 0.0), 3.0, (320, 240)
            )
            for roof_m in (0.0, 1.0)
        ]
        # What roofs may explain says less about the pose: in no direction more.
        lost = informed[0].information - informed[1].information
        assert np.linalg.eigvalsh(lost).min() > -1e-6 * np.abs(informed[0].information).max()
        assert lost[2, 2] > 0


class TestMethod:
    def test_finds_tilted_cameras(self, estimates, truths):
        for estimate, truth in zip(estimates, truths, strict=True):
            error = pose_error(estimate.pose, truth)
            # A pixel of these small pictures is 0.45 m on the ground.
            assert error.translation_m < 0.7
            assert error.rotation_deg < 0.3
            assert estimate.score > 0.98

    def test_says_how_sure_it_is(self, estimates):
        for estimate in estimates:
            assert estimate.probability > 0.9
            np.testing.assert_allclose(estimate.covariance, estimate.covariance.T)
            assert np.linalg.eigvalsh(estimate.covariance).min() > 0

    def test_does_not_depend_on_threads(self, tilted_queries, scene, estimates):
        two = ContourAlignment(SMALL).localize(tilted_queries[1], CityMap(scene, threads=2), STREAMS)
        np.testing.assert_array_equal(two.pose.cam_from_world, estimates[1].pose.cam_from_world)
        np.testing.assert_array_equal(two.covariance, estimates[1].covariance)

    def test_the_map_counts_what_it_renders(self, tilted_queries, city_map):
        method = ContourAlignment(replace(SMALL, steps=2, final_steps=3))
        counted = localize_query(method, tilted_queries[0], city_map, STREAMS).hypotheses
        # The grid; two steps and a look for each of the starts; three steps and a look of every track.
        searched = len(method.params.grid()) + method.params.starts * 3
        assert searched + 4 <= counted <= searched + 4 * len(TRACKS)

    def test_missing_buildings_do_not_pull(self, tilted_queries, city_map, truths):
        mask = tilted_queries[0].building_probability.copy()
        mask[:, :110] = 0
        query = replace(tilted_queries[0], building_probability=mask)
        estimate = ContourAlignment(SMALL).localize(query, city_map, STREAMS)
        assert pose_error(estimate.pose, truths[0]).translation_m < 1.0

    def test_hidden_feet_are_told_from_a_wrong_pose(
        self, tilted_queries, scene, city_map, truths, monkeypatch
    ):
        """Walls end 2.5 m too high in the mask: a method that knows of no such thing sinks by metres."""
        hidden = scene.vertices.copy()
        for first, last in pairwise(scene.vertex_starts):
            hidden[first:last, 2] = np.maximum(hidden[first:last, 2], hidden[first:last, 2].min() + 2.5)
        seen = CityMap(replace(scene, vertices=hidden), threads=1).render(CAMERA, truths[0])
        query = replace(tilted_queries[0], building_probability=seen.astype(np.float32))
        errors = []
        for tracks in (TRACKS, ((TRACKS[0][0][:1], False),)):
            monkeypatch.setattr("lodbench.methods.contour_alignment.refinement.TRACKS", tracks)
            estimate = ContourAlignment(SMALL).localize(query, city_map, STREAMS)
            errors.append(pose_error(estimate.pose, truths[0]).translation_m)
        assert errors[0] < 1.0
        assert errors[1] > 1.5

    def test_a_mask_the_wrong_way_round_is_not_believed(self, tilted_queries, city_map):
        query = tilted_queries[0]
        inverted = replace(query, building_probability=1.0 - query.building_probability)
        assert ContourAlignment(SMALL).localize(inverted, city_map, STREAMS).probability < 0.1

    def test_an_answer_beyond_the_told_range_says_so(self, tilted_queries, city_map):
        told = replace(SMALL, range_z_m=8.0)
        estimate = ContourAlignment(told).localize(tilted_queries[0], city_map, STREAMS)
        (note,) = estimate.notes
        assert "beyond the range" in note
        assert "z -" in note
        assert "x" not in note.partition(":")[2]
        assert ContourAlignment(SMALL).localize(tilted_queries[0], city_map, STREAMS).notes == ()

    def test_basins_find_what_the_grid_finds_with_a_tenth_of_the_hypotheses(self, city_map, truths):
        wide = SMALL.for_prior(UniformPrior(x_m=50.0, y_m=50.0, z_m=40.0, pitch_deg=0.5, roll_deg=0.5))
        mask = city_map.render(CAMERA, truths[0]).astype(np.float32)
        query = Query("q", "all", CAMERA, tilted(truths[0], (31, -38, 26, 0.3, -0.4, 5)), mask)
        grid, basins = (
            localize_query(ContourAlignment(replace(wide, search=search)), query, city_map, STREAMS)
            for search in ("grid", "basins")
        )
        assert pose_error(basins.pose, grid.pose).translation_m < 0.2
        assert basins.hypotheses * 8 < grid.hypotheses

    def test_an_empty_mask_is_a_fault_of_the_query(self, tilted_queries, city_map):
        query = replace(tilted_queries[0], building_probability=np.zeros((240, 320), dtype=np.float32))
        with pytest.raises(QueryFault, match="no building"):
            ContourAlignment(SMALL).localize(query, city_map, STREAMS)

    def test_a_prior_far_from_the_city_is_a_fault_of_the_query(self, tilted_queries, city_map):
        query = replace(tilted_queries[0], prior=tilted_queries[0].prior.shifted([9000, 0, 0]))
        with pytest.raises(QueryFault, match="far from the city"):
            ContourAlignment(SMALL).localize(query, city_map, STREAMS)


class TestWeights:
    """Points off by as much, outside the mask and inside, seen with outlines of several qualities."""

    @staticmethod
    def weights(noise_px, params):
        distances = np.array([-9.0, -3.0, 3.0, 9.0])
        agreement = np.ones(4)
        here = Residuals(None, distances, None, agreement, 1.0, 1.0)
        slopes = np.zeros((4, 10))
        return _weights(here, slopes, distances, noise_px, TRACKS[0][0][0], params)

    def test_what_a_rough_mask_misses_counts_less_than_what_it_adds(self):
        far_out, out, within, far_within = self.weights(4.0, Params())
        assert far_out < out < within
        assert far_out < 0.5 * far_within
        np.testing.assert_array_equal(
            self.weights(4.0, Params(hidden_sigmas=3.0)), [far_within, within, within, far_within]
        )

    def test_a_fine_mask_misses_as_much_as_it_adds(self):
        far_out, out, within, far_within = self.weights(1.7, Params())
        assert (far_out, out) == (far_within, within)

    @given(st.floats(0.5, 5.9))
    def test_no_outline_changes_its_side_at_once(self, noise_px):
        one, other = (self.weights(noise_px + more, Params()) for more in (0.0, 1e-6))
        np.testing.assert_allclose(one, other, rtol=1e-4)


class TestDealing:
    @pytest.mark.parametrize("largest", [3, 128, 300])
    def test_every_point_is_dealt_once_and_small_buildings_stay_whole(self, largest):
        generator = np.random.default_rng(largest)
        building = np.repeat(np.arange(30), generator.integers(1, largest + 1, 30))
        count = len(building)
        outline = OutlinePoints(
            generator.uniform(0, 400, (count, 2)), np.zeros((count, 2)), np.ones(count),
            np.zeros((count, 9, 2)), building, np.zeros((count, 2)),
        )  # fmt: skip
        here = Residuals(outline, np.zeros(count), np.zeros((count, 9)), np.ones(count), 1.0, 1.0)
        chunks = deal_out(here).chunks
        assert sorted(np.concatenate(chunks)) == list(range(count))
        assert max(len(chunk) for chunk in chunks) <= 128
        for number, size in enumerate(np.bincount(building)):
            if size <= 128:
                assert sum(number in building[chunk] for chunk in chunks) == 1


class TestCertainty:
    VECTOR = vector_from_pose(Pose.from_euler(EulerAngles(40, 1, 20), [0, 0, 100]))

    def test_agrees_with_the_distribution_of_a_length(self):
        # A centre with 1 m along each axis is within 2 m with the probability of chi, three degrees.
        spread = np.diag([1.0, 1.0, 1.0, 1e-8, 1e-8, 1e-8])
        assert probability_within(spread, self.VECTOR) == pytest.approx(0.7385, abs=0.03)

    def test_falls_with_the_spread_of_either_part(self):
        sizes = [0.2, 0.7, 1.5, 4.0]
        for part in (slice(0, 3), slice(3, 6)):
            said = []
            for size in sizes:
                spread = np.full(6, 1e-4)
                spread[part] = size**2
                said.append(probability_within(np.diag(spread), self.VECTOR))
            assert said == sorted(said, reverse=True)
            assert said[0] == 1.0
            assert said[-1] < 0.15


class TestParams:
    def test_reaches_what_a_prior_leaves_open(self):
        params = Params().for_prior(
            UniformPrior(x_m=50, y_m=60, z_m=70, yaw_deg=9, pitch_deg=0.3, roll_deg=0.3)
        )
        assert (params.range_x_m, params.range_y_m, params.range_z_m) == (100, 120, 140)
        assert params.prior_sigmas()[3] == pytest.approx(0.3 / np.sqrt(3))
        assert params.searches_basins()
        assert not Params().searches_basins()

    def test_the_grid_of_the_published_priors_is_lodlocv2_s(self):
        grid = Params().grid()
        assert [axis.count for axis in (grid.x, grid.y, grid.z, grid.yaw)] == [3, 3, 7, 8]

    @pytest.mark.parametrize(
        "values",
        [
            {"search": "everywhere"},
            {"starts": 0},
            {"steps": -1},
            {"noise_px": 0.0},
            {"roof_m": -1.0},
            {"range_x_m": float("nan")},
            {"basin_share": 0.0},
            {"fine_size": (2, 2)},
        ],
    )
    def test_what_makes_no_sense(self, values):
        with pytest.raises(ConfigError, match=next(iter(values))):
            Params(**values)

    def test_the_configuration_says_every_default(self):
        from omegaconf import OmegaConf

        path = Path(__file__).parents[2] / "conf/method/contour_alignment.yaml"
        stored = OmegaConf.to_container(OmegaConf.load(path))
        default = Params()
        assert stored.keys() == {field.name for field in fields(default)}
        assert Params(**stored) == default


class TestAlternatives:
    """Hypotheses that put the camera elsewhere are told, those of one place as one, with their weight."""

    def mixture(self, *places: tuple[float, float]) -> Refined:
        modes = tuple(
            Mode(TRACKS[0][0][k], False, False, np.array([east, *[0.0] * 9]), 25.0 * np.eye(10), -float(k))
            for k, (east, _) in enumerate(places)
        )
        weights = np.array([weight for _, weight in places])
        return Refined(np.array([0.0, 0.0, 100.0, 30.0, 0.0, 10.0, 0.0]), modes, weights, 0.9)

    def test_weights_of_one_place_are_added(self):
        answer = answer_of(self.mixture((0.0, 0.6), (10.0, 0.2), (10.5, 0.15), (-20.0, 0.05)))
        np.testing.assert_allclose(answer.alternative_probabilities, [0.35, 0.05])
        np.testing.assert_allclose([pose.center[0] for pose in answer.alternatives], [10.0, -20.0])
        assert answer.probability == pytest.approx(0.6, abs=0.02)

    def test_the_unlikely_and_the_near_are_none(self):
        answer = answer_of(self.mixture((0.0, 0.7), (1.0, 0.29), (30.0, 0.01)))
        assert answer.alternatives == answer.alternative_probabilities == ()
