from __future__ import annotations

import json
import math

import numpy as np
import pytest

from lodbench.bench.accuracy import AccuracyOptions, make_cases, measure_accuracy
from lodbench.bench.accuracy_report import AccuracyReport, Outcome
from lodbench.citymodel import open_scene
from lodbench.datasets.roughening import mask_iou
from lodbench.datasets.views import FINE_SIZE, RGB_CAMERA
from lodbench.errors import ConfigError
from lodbench.evaluation import PoseError, pose_error
from lodbench.evaluation.errors import FAILED
from lodbench.rendering import make_renderer


@pytest.fixture(scope="module")
def cases(city):
    scene = open_scene(city)
    scorer = make_renderer("silhouette", scene, 1)
    return make_cases(scene, scorer, AccuracyOptions(num_views=3, threads=1))[0], scorer


class TestCases:
    def test_masks_are_as_wrong_as_asked(self, cases):
        for case in cases[0]:
            clean = cases[1].render(RGB_CAMERA.scaled(*FINE_SIZE), case.truth)
            mask = case.query.building_probability >= 0.5
            assert mask.shape == (448, 602)
            assert case.achieved_iou == mask_iou(mask, clean)
            assert case.achieved_iou == pytest.approx(0.88, abs=0.005)

    def test_priors_lie_in_the_asked_ranges(self, cases):
        for case in cases[0]:
            offset = np.abs(case.query.prior.center - case.truth.center)
            assert (offset <= np.array([10, 10, 30]) + 1e-9).all()
            turns = np.abs(np.subtract(case.query.prior.euler, case.truth.euler))
            assert turns[0] <= 1 + 1e-6
            assert turns[1] <= 1 + 1e-6

    def test_true_tilt_changes_nothing_else(self, cases):
        case = cases[0][0]
        drawn, true = (case.query_with_tilt(tilt) for tilt in ("prior", "truth"))
        np.testing.assert_array_equal(drawn.prior.center, case.query.prior.center)
        np.testing.assert_allclose(true.prior.center, drawn.prior.center, atol=1e-9)
        np.testing.assert_allclose(true.prior.euler[:2], case.truth.euler[:2], atol=1e-9)
        assert true.prior.euler.yaw_deg == pytest.approx(drawn.prior.euler.yaw_deg)
        assert pose_error(drawn.prior, true.prior).rotation_deg > 0.01

    def test_more_views_keep_the_first_ones(self, city, cases):
        fewer, _ = make_cases(open_scene(city), cases[1], AccuracyOptions(num_views=1, threads=1))
        np.testing.assert_array_equal(fewer[0].truth.cam_from_world, cases[0][0].truth.cam_from_world)
        np.testing.assert_array_equal(
            fewer[0].query.building_probability, cases[0][0].query.building_probability
        )


@pytest.fixture(scope="module")
def report(city):
    steps = []
    report = measure_accuracy(city, AccuracyOptions(num_views=2), lambda *step: steps.append(step))
    assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]
    return report


class TestMeasure:
    def test_two_blocks_of_every_view(self, report):
        assert [o.name for o in report.of_tilt("truth")] == ["view_0000", "view_0001"]
        assert [o.name for o in report.of_tilt("prior")] == ["view_0000", "view_0001"]
        assert all(o.hypotheses == 2425 and o.score > 0.5 for o in report.outcomes)

    def test_does_not_depend_on_threads(self, city, report):
        one = measure_accuracy(city, AccuracyOptions(num_views=1, threads=1))
        for tilt in ("truth", "prior"):
            assert one.of_tilt(tilt)[0].error == report.of_tilt(tilt)[0].error

    def test_text_says_what_was_drawn(self, report):
        text = report.to_text()
        for part in (
            "tilt=truth  prior",
            "tilt=prior  lodlocv2",
            "602 x 448",
            "IoU 0.88",
            "seed 0",
            "2 views",
        ):
            assert part in text


def outcome(tilt, error, score=0.9, truth_score=0.88, hypotheses=2425):
    return Outcome("v", tilt, error, PoseError(15.0, 4.0), score, truth_score, hypotheses, 0.5)


class TestReport:
    REPORT = AccuracyReport(
        "city.obj",
        "lodlocv2",
        "protocol",
        3,
        (
            outcome("truth", PoseError(0.5, 0.1)),
            outcome("truth", PoseError(9.0, 0.1), score=0.5),
            outcome("prior", PoseError(2.5, 0.1)),
            outcome("prior", FAILED, score=0.0, hypotheses=0),
        ),
    )

    def test_failures_count(self):
        assert self.REPORT.summary("truth").recall["2m-2deg"] == 50
        assert self.REPORT.summary("prior").recall["3m-3deg"] == 50
        assert self.REPORT.summary("prior").num_failed == 1
        assert self.REPORT.summary("prior").hypotheses_per_query == 2425

    def test_text_tells_search_from_ambiguity(self):
        assert "tilt=truth: 1 not within (2 m, 2 deg); in 1 of them the truth fits" in self.REPORT.to_text()

    def test_figures_are_json(self):
        figures = [figure.to_json() for figure in self.REPORT.figures()]
        json.dumps(figures, allow_nan=False)
        names = [figure["figure"] for figure in figures]
        assert len(set(names)) == len(names)
        recall = next(f for f in figures if f["figure"] == "recall 2m-2deg tilt=truth")
        assert (recall["value"], recall["unit"], recall["peer"], recall["peer_value"]) == (
            50.0,
            "%",
            "prior",
            0,
        )
        median = next(f for f in figures if f["figure"] == "median_translation_m tilt=prior")
        assert median["value"] is None


@pytest.mark.parametrize(
    "values",
    [{"num_views": 0}, {"mask_iou": 0.0}, {"mask_iou": 1.2}, {"tilt_deg": -1.0}, {"tilt_deg": math.nan}],
)
def test_options_that_make_no_sense(values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        AccuracyOptions(**values)
