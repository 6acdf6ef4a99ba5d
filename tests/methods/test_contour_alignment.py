"""Six degrees of freedom: slopes against finite differences, poses found, the answer's certainty."""

from dataclasses import fields, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, QueryFault
from lodbench.estimation.outline_alignment import Aligner, smooth_distance
from lodbench.evaluation import pose_error
from lodbench.geometry import Pose
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.contour_alignment import ContourAlignment, ContourAlignmentParams
from lodbench.methods.contour_alignment.likelihood import TRACKS
from lodbench.methods.localize import localize_query
from lodbench.storage import random_stream
from tests.town import BOXES, CAMERA, box_obj

STREAMS = partial(random_stream, 0, "test")
# Masks and map are exact: half a pixel of noise is more than they have, and no roof is wrong.
SMALL = ContourAlignmentParams(coarse_size=(160, 120), fine_size=(320, 240), noise_px=0.5, roof_m=0.0)


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


class TestAlignment:
    def test_the_gradient_vanishes_where_it_ends(self, tilted_queries, city_map):
        query = tilted_queries[0]
        aligner = Aligner(query, city_map, SMALL.outline_model())
        start = np.append(vector_from_pose(query.prior), 0.0)
        vector = aligner.align(start, (24.0, 16.0, 12.0, 8.0, 6.0, 4.0, 3.0, 3.0, 3.0, 3.0), (320, 240))
        step = aligner.linearize(vector, 3.0, (320, 240)).posterior.step()
        assert np.linalg.norm(step[:3]) < 0.2
        assert np.linalg.norm(step[3:]) < 0.05

    def test_an_empty_view_is_no_information(self, tilted_queries, city_map):
        aligner = Aligner(tilted_queries[0], city_map, SMALL.outline_model())
        away = np.append(vector_from_pose(tilted_queries[0].prior.shifted([5000, 0, 0])), 0.0)
        assert aligner.linearize(away, 3.0, (320, 240)) is None

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
            np.sqrt(np.mean((found - exact)[near] ** 2)) for found in (smooth_distance(exact > 0), stairs)
        ]
        assert errors[0] < 0.22
        assert errors[0] < 0.8 * errors[1]

    def test_a_wrong_height_of_a_roof_is_told_from_a_wrong_pose(self, tilted_queries, city_map, truths):
        query = tilted_queries[0]
        informed = [
            Aligner(query, city_map, replace(SMALL, roof_m=roof_m).outline_model()).linearize(
                np.append(vector_from_pose(truths[0]), 0.0), 3.0, (320, 240)
            )
            for roof_m in (0.0, 1.0)
        ]
        # What roofs may explain says less about the pose: in no direction more.
        lost = informed[0].posterior.information - informed[1].posterior.information
        assert np.linalg.eigvalsh(lost).min() > -1e-6 * np.abs(informed[0].posterior.information).max()
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
        # The grid; two steps and a look for each of the starts; three steps and a look of every track; then
        # the answer is compared with the mask.
        searched = len(method.params.grid()) + method.params.starts * 3 + 1
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
            monkeypatch.setattr("lodbench.methods.contour_alignment.method.TRACKS", tracks)
            estimate = ContourAlignment(SMALL).localize(query, city_map, STREAMS)
            errors.append(pose_error(estimate.pose, truths[0]).translation_m)
        assert errors[0] < 1.0
        assert errors[1] > 1.5

    def test_a_map_of_few_of_the_buildings_is_believed_as_one_of_all(self, tilted_queries, truths, tmp_path):
        """Masks hold what the map has not: a right pose is no worse for it, a wrong one no better."""
        (tmp_path / "city.obj").write_text(box_obj([BOXES[k] for k in (0, 2, 4)]))
        some = CityMap(open_scene(tmp_path / "city.obj"), threads=1)
        for query, truth in zip(tilted_queries[:2], truths, strict=False):
            mapped, mask = some.render(CAMERA, truth), query.mask > 0.5
            assert np.count_nonzero(mapped & mask) / np.count_nonzero(mapped | mask) < 0.7
            estimate = ContourAlignment(SMALL).localize(query, some, STREAMS)
            assert pose_error(estimate.pose, truth).translation_m < 2.0
            assert estimate.score > 0.8
            assert estimate.probability > 0.5
            mirrored = replace(query, building_probability=np.ascontiguousarray(query.mask[:, ::-1]))
            assert ContourAlignment(SMALL).localize(mirrored, some, STREAMS).probability < 0.3

    def test_a_mask_the_wrong_way_round_is_not_believed(self, tilted_queries, city_map):
        query = tilted_queries[0]
        inverted = replace(query, building_probability=1.0 - query.building_probability)
        assert ContourAlignment(SMALL).localize(inverted, city_map, STREAMS).probability < 0.1

    def test_an_answer_beyond_the_told_range_says_so(self, tilted_queries, city_map):
        told = replace(SMALL, range_z_m=8.0)
        estimate = ContourAlignment(told).localize(tilted_queries[0], city_map, STREAMS)
        (note,) = estimate.notes
        assert "outside the stated range" in note
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


class TestParams:
    def test_reaches_what_a_prior_leaves_open(self):
        params = ContourAlignmentParams().for_prior(
            UniformPrior(x_m=50, y_m=60, z_m=70, yaw_deg=9, pitch_deg=0.3, roll_deg=0.3)
        )
        assert (params.range_x_m, params.range_y_m, params.range_z_m) == (100, 120, 140)
        assert params.prior_sigmas()[3] == pytest.approx(0.3 / np.sqrt(3))
        assert params.searches_basins()
        assert not ContourAlignmentParams().searches_basins()

    def test_starts_are_closer_over_near_buildings_and_as_before_over_far_ones(self):
        params = ContourAlignmentParams()
        assert params.over(2.6) == replace(params, search="grid")
        near, nearest = params.over(9.0), params.over(40.0)
        assert near.stride_m == pytest.approx(60.0 / 9.0)
        assert nearest.stride_m == pytest.approx(5.0)
        assert nearest.basin_stride_m == pytest.approx(12.5)
        assert len(params.grid()) < len(near.grid()) < len(nearest.grid()) < 2000
        assert nearest.starts == 16

    def test_a_prior_of_basins_keeps_them_however_near_buildings_are(self):
        wide = ContourAlignmentParams(range_x_m=200.0, range_y_m=200.0)
        assert wide.over(1.0).searches_basins()
        assert wide.over(40.0).searches_basins()
        assert not ContourAlignmentParams(range_x_m=40.0, range_y_m=40.0).over(40.0).searches_basins()

    def test_the_scale_is_that_of_the_nearest_camera_the_prior_leaves_open(self, tilted_queries, city_map):
        aligner = Aligner(tilted_queries[0], city_map, SMALL.outline_model())
        exact, open_20_m = (aligner.pixels_per_m(nearer_m) for nearer_m in (0.0, 20.0))
        focal_px = CAMERA.scaled(*SMALL.fine_size).fx
        assert focal_px / open_20_m == pytest.approx(focal_px / exact - 20.0)

    def test_the_grid_of_the_published_priors_is_lodlocv2_s(self):
        grid = ContourAlignmentParams().grid()
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
            ContourAlignmentParams(**values)

    def test_the_configuration_says_every_default(self):
        from omegaconf import OmegaConf

        path = Path(__file__).parents[2] / "conf/method/contour_alignment.yaml"
        stored = OmegaConf.to_container(OmegaConf.load(path))
        default = ContourAlignmentParams()
        assert stored.keys() == {field.name for field in fields(default)}
        assert ContourAlignmentParams(**stored) == default
