import inspect
from dataclasses import fields, replace
from functools import partial

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.datasets.query import Dataset, Query
from lodbench.errors import ConfigError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.harness.runs.requirements import made_inputs
from lodbench.methods import Input, Method
from lodbench.methods.fits import PoseScorer
from lodbench.methods.localize import localize_query
from lodbench.methods.lodlocv2 import LodLocV2, LodLocV2Params, select
from lodbench.storage import random_stream

SMALL = {"coarse_size": (160, 120), "fine_size": (320, 240)}
# Fewer steps than the paper's 40: enough for a town of seven boxes.
QUICK = LodLocV2Params(steps=12, **SMALL)


def streams_of(seed: int):
    """Returns the streams a run would hand a method."""
    return partial(random_stream, seed, "tests", "query")


def as_numbers(estimate) -> tuple:
    """Returns all of an estimate but its wall times, exactly."""
    return (estimate.pose.cam_from_world.tobytes(), estimate.score, tuple(sorted(estimate.trace.items())))


class TestFull:
    def test_finds_every_pose_with_true_tilt(self, queries, city_map, truths):
        for query, truth in zip(queries, truths, strict=True):
            before = pose_error(query.prior, truth)
            estimate = LodLocV2(LodLocV2Params(**SMALL)).localize(query, city_map, streams_of(0))
            after = pose_error(estimate.pose, truth)
            assert before.translation_m > 8
            assert after.translation_m < 0.5
            assert after.rotation_deg < 0.2
            assert estimate.score > 0.97

    def test_tilt_stays_the_priors(self, queries, city_map):
        query = queries[0]
        pitch, roll, _ = query.prior.euler
        found = LodLocV2(QUICK).localize(query, city_map, streams_of(0)).pose.euler
        np.testing.assert_allclose(found[:2], (pitch, roll), atol=1e-9)

    def test_counts_its_hypotheses(self, queries, city_map):
        estimate = localize_query(LodLocV2(LodLocV2Params(**SMALL)), queries[0], city_map, streams_of(0))
        # The grid, its winner at the fine size, and 40 steps of 52 candidates less the 4 kept.
        assert estimate.hypotheses == 504 + 1 + 40 * 48

    def test_the_score_never_falls(self, queries, city_map):
        for query in queries:
            trace = LodLocV2(QUICK).localize(query, city_map, streams_of(3)).trace
            assert len(trace["fine"]) == QUICK.steps
            assert (np.diff(trace["fine"]) >= 0).all()

    def test_the_score_is_that_of_the_answer(self, queries, city_map):
        query = queries[1]
        estimate = LodLocV2(QUICK).localize(query, city_map, streams_of(0))
        drawn = city_map.render(query.camera.scaled(320, 240), estimate.pose)
        mask = query.building_probability >= 0.5
        assert estimate.score == np.count_nonzero(drawn & mask) / np.count_nonzero(drawn | mask)
        assert estimate.score == estimate.trace["fine"][-1]

    def test_wall_times_by_stage(self, queries, city_map):
        seconds = LodLocV2(QUICK).localize(queries[0], city_map, streams_of(0)).seconds
        assert set(seconds) == {"coarse", "fine"}
        assert min(seconds.values()) > 0


class TestDeterminism:
    def test_same_seed_same_answer(self, queries, city_map):
        first, second = (LodLocV2(QUICK).localize(queries[0], city_map, streams_of(5)) for _ in range(2))
        assert as_numbers(first) == as_numbers(second)

    def test_another_seed_another_answer(self, queries, city_map):
        first, second = (LodLocV2(QUICK).localize(queries[0], city_map, streams_of(s)) for s in (5, 6))
        assert as_numbers(first) != as_numbers(second)

    @pytest.mark.parametrize("threads", [2, 3])
    def test_threads_change_no_byte(self, queries, scene, city_map, threads):
        one = LodLocV2(QUICK).localize(queries[0], city_map, streams_of(0))
        many = LodLocV2(QUICK).localize(queries[0], CityMap(scene, threads=threads), streams_of(0))
        assert as_numbers(one) == as_numbers(many)

    def test_any_batch_size_changes_no_byte(self, queries, city_map):
        class OneByOne:
            name, scene = city_map.name, city_map.scene

            def fit(self, camera, rotations, centers, fit):
                parts = [
                    city_map.fit(camera, rotations[i : i + 1], centers[i : i + 1], fit)
                    for i in range(len(centers))
                ]
                return np.concatenate(parts)

        whole = LodLocV2(QUICK).localize(queries[0], city_map, streams_of(0))
        single = LodLocV2(QUICK).localize(queries[0], OneByOne(), streams_of(0))
        assert as_numbers(whole) == as_numbers(single)

    def test_nothing_is_kept_between_queries(self, queries, city_map):
        method = LodLocV2(QUICK)
        alone = LodLocV2(QUICK).localize(queries[1], city_map, streams_of(0))
        method.localize(queries[0], city_map, streams_of(0))
        assert as_numbers(method.localize(queries[1], city_map, streams_of(0))) == as_numbers(alone)


class TestVariants:
    def test_no_refine_answers_with_a_pose_of_the_grid(self, queries, city_map):
        params = LodLocV2Params(variant="no_refine", **SMALL)
        for query in queries:
            estimate = localize_query(LodLocV2(params), query, city_map, streams_of(0))
            centers, yaws = params.grid().around(query.prior)
            offset = np.abs(centers - estimate.pose.center).max(axis=1) + np.abs(
                yaws - estimate.pose.euler.yaw_deg
            )
            assert offset.min() < 1e-9
            assert estimate.hypotheses == 504
            assert set(estimate.trace) == {"coarse"}

    def test_no_refine_does_not_depend_on_the_seed(self, queries, city_map):
        params = LodLocV2Params(variant="no_refine", **SMALL)
        first, second = (LodLocV2(params).localize(queries[0], city_map, streams_of(s)) for s in (1, 2))
        assert as_numbers(first) == as_numbers(second)

    def test_no_select_stays_within_the_filters_reach(self, queries, city_map):
        params = LodLocV2Params(variant="no_select", steps=12, sigma_m=0.05, spread_yaw_deg=0.1, **SMALL)
        query = queries[0]
        estimate = localize_query(LodLocV2(params), query, city_map, streams_of(0))
        assert estimate.hypotheses == 1 + 12 * 48
        # Five standard deviations a step, and the full turn a step.
        moved = np.linalg.norm(estimate.pose.center - query.prior.center)
        turned = abs(estimate.pose.euler.yaw_deg - query.prior.euler.yaw_deg)
        assert 0 < moved < 12 * 5 * 0.05
        assert 0 < turned < 12 * 0.1

    def test_a_filter_that_does_not_move_answers_with_the_prior(self, queries, city_map):
        params = LodLocV2Params(variant="no_select", steps=2, sigma_m=0.0, spread_yaw_deg=0.0, **SMALL)
        estimate = LodLocV2(params).localize(queries[0], city_map, streams_of(0))
        np.testing.assert_allclose(estimate.pose.cam_from_world, queries[0].prior.cam_from_world, atol=1e-9)


class TestFits:
    @pytest.mark.parametrize("fit", ["soft_iou", "confident_iou", "boundary"])
    def test_other_costs_find_the_pose_too(self, queries, city_map, truths, fit):
        # Blurred, as a network's answer is; the grid is too coarse for outlines a few pixels wide.
        query = queries[0]
        soft = cv2.GaussianBlur(query.building_probability.astype(np.float32), (0, 0), 1.0)
        query = replace(query, building_probability=np.clip(soft, 0, 1))
        estimate = LodLocV2(LodLocV2Params(fit=fit, **SMALL)).localize(query, city_map, streams_of(0))
        after = pose_error(estimate.pose, truths[0])
        assert after.translation_m < 1.0
        assert after.rotation_deg < 0.5
        assert 0.7 < estimate.score <= 1.0

    def test_the_photos_own_statistics_need_no_mask(self, queries, city_map, truths, tmp_path):
        method = LodLocV2(LodLocV2Params(fit="region", **SMALL))
        assert method.requires == {Input.IMAGE}
        assert LodLocV2().requires == {Input.MASK}
        truth = queries[0].mask >= 0.5
        photo = np.random.default_rng(0).integers(40, 120, (*truth.shape, 3)).astype(np.uint8)
        photo[truth] += 80
        cv2.imwrite(str(tmp_path / "photo.png"), photo)
        query = replace(queries[0], building_probability=None, image=tmp_path / "photo.png")
        after = pose_error(method.localize(query, city_map, streams_of(0)).pose, truths[0])
        assert after.translation_m < 1.0
        assert after.rotation_deg < 0.5
        with pytest.raises(QueryFault, match="there is no photo"):
            method.localize(replace(query, image=None), city_map, streams_of(0))

    def test_an_unknown_one_names_the_nearest(self):
        with pytest.raises(ConfigError, match="bondary") as caught:
            LodLocV2Params(fit="bondary")
        assert "boundary" in caught.value.hint

    def test_a_mask_that_cannot_tell(self, queries, city_map):
        query = replace(queries[0], building_probability=np.full((240, 320), 0.5, dtype=np.float32))
        with pytest.raises(QueryFault, match="no information"):
            LodLocV2(LodLocV2Params(fit="confident_iou", **SMALL)).localize(query, city_map, streams_of(0))


class TestTies:
    def test_the_first_of_equal_hypotheses_wins(self, queries, city_map):
        score = PoseScorer(queries[0], city_map, (160, 120))
        prior = queries[0].prior
        # All are too far up to see a pixel of the town, so all score 0.
        centers = prior.center + np.array([[0.0, 0.0, 5000.0], [9.0, 0.0, 5000.0], [0.0, 9.0, 5000.0]])
        best = select(score, centers, np.full(3, prior.euler.yaw_deg))
        np.testing.assert_array_equal(best.centers, centers[:1])

    def test_the_filter_keeps_the_start_when_nothing_is_better(self, queries, scene):
        class Flat:
            name = "flat"

            def __init__(self):
                self.scene = scene

            def fit(self, camera, rotations, centers, fit):
                return np.full(len(centers), 0.5)

        params = LodLocV2Params(variant="no_select", steps=3, **SMALL)
        estimate = LodLocV2(params).localize(queries[0], Flat(), streams_of(0))
        np.testing.assert_allclose(estimate.pose.center, queries[0].prior.center, atol=1e-9)
        params = LodLocV2Params(variant="no_refine", **SMALL)
        estimate = LodLocV2(params).localize(queries[0], Flat(), streams_of(0))
        first = params.grid().around(queries[0].prior)[0][0]
        np.testing.assert_allclose(estimate.pose.center, first, atol=1e-9)


class TestFaults:
    @pytest.mark.parametrize("variant", ["full", "no_refine", "no_select"])
    def test_an_empty_mask(self, queries, city_map, variant):
        query = replace(queries[0], building_probability=np.zeros((240, 320), dtype=np.float32))
        with pytest.raises(QueryFault, match="no building"):
            LodLocV2(LodLocV2Params(variant=variant, **SMALL)).localize(query, city_map, streams_of(0))

    @pytest.mark.parametrize("variant", ["full", "no_refine", "no_select"])
    def test_a_camera_far_from_the_city(self, queries, city_map, variant):
        query = replace(queries[0], prior=queries[0].prior.shifted([50_000, 0, 0]))
        with pytest.raises(QueryFault, match="far from the city"):
            LodLocV2(LodLocV2Params(variant=variant, steps=2, **SMALL)).localize(
                query, city_map, streams_of(0)
            )

    def test_a_camera_that_looks_at_the_sky(self, queries, city_map):
        up = Pose.from_euler(EulerAngles(175.0, 0.0, 0.0), queries[0].prior.center)
        with pytest.raises(QueryFault):
            LodLocV2(LodLocV2Params(steps=2, **SMALL)).localize(
                replace(queries[0], prior=up), city_map, streams_of(0)
            )


class TestTheMethodNeverSeesTheTruth:
    def test_a_query_holds_none(self):
        assert {f.name for f in fields(Query)} == {
            "name",
            "split",
            "camera",
            "prior",
            "building_probability",
            "classes",
            "image",
            "hypotheses",
            "instances",
            "segment",
            "sequence",
            "reconstructed",  # in a frame of its own
            "lens_percent",
            "camera_sigmas",
            "measured",  # beside the photo: a receiver, a laser
            "time_s",
            "true_pixels",  # for oracles alone
        }
        assert Input.TRUE_PIXELS not in made_inputs(LodLocV2())

    def test_nor_does_any_argument_of_localize(self):
        arguments = inspect.signature(Method.localize).parameters
        assert list(arguments) == ["self", "query", "city_map", "streams"]
        assert "truth" in {f.name for f in fields(Dataset)}
        assert not any("Dataset" in str(p.annotation) for p in arguments.values())
