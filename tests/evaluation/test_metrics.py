"""Metrics by hand, calibration; metrics of other packages, left out where they fail."""

import math
import re
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from lodbench.evaluation import metrics
from lodbench.evaluation.metrics import (
    COLUMNS,
    ERROR,
    PARTS,
    calibrate,
    queries_frame,
    risk_coverage,
    share_rejectable,
    share_rejected,
    summarize_queries,
)
from lodbench.evaluation.pose_errors import FAILED, FAILED_PARTS
from lodbench.plugins import PlugIn, installed
from lodbench.storage import random_stream


def frame(*rows: dict):
    return queries_frame({"query": f"{i}", "split": "a", "failure": "", **row} for i, row in enumerate(rows))


def errors(metres: float, degrees: float, *parts: float, **more: float) -> dict:
    return {
        **dict(zip(ERROR, (metres, degrees), strict=True)),
        **dict(zip(PARTS, parts, strict=False)),
        **more,
    }


QUERIES = frame(
    errors(1.0, 0.2, 0.6, -0.8, 0.1, mask_iou=0.8, hypotheses=10),
    errors(4.0, 1.0, 4.0, 0.0, -1.0, mask_iou=0.9, hypotheses=30),
    {**errors(*FAILED, *FAILED_PARTS, hypotheses=0), "failure": "no mask"},
    {"failure": "no true pose to compare with", "hypotheses": 20},
)


def test_parts_of_the_error_and_masks_by_hand():
    found = summarize_queries(QUERIES, "a")[0]
    numbers = {"median_horizontal_m": 4.0, "median_vertical_m": 0.8, "median_yaw_deg": 1.0}
    assert {name: found.metrics[name] for name in numbers} == numbers
    assert found.metrics["mask_iou"] == pytest.approx(0.85)
    # Without a truth a query is in no denominator, but an answer all the same.
    assert (found.num_queries, found.num_failed, found.hypotheses_per_query) == (3, 1, 20.0)


def test_the_numbers_of_our_own_metrics_are_known_by_name():
    ours = [point.load() for point in installed("metrics") if point.is_ours]
    assert {name for metric in ours for name in metric(QUERIES)} == metrics.OWN_NUMBERS


def test_unanswered_queries_without_a_truth_are_failed_ones():
    reasons = ("no true pose to compare with", "no true pose to compare with; no mask")
    found = summarize_queries(frame(*({"failure": reason, "hypotheses": 1} for reason in reasons)), "a")[0]
    assert (found.num_queries, found.num_failed) == (0, 1)


def test_probabilities_are_compared_with_what_was_found():
    rows = [(0.5, 0.5, 0.95), (1.0, 1.0, 0.85), (9.0, 1.0, 0.25), (*FAILED, math.nan)]
    queries = frame(*(errors(m, deg, probability=p) for m, deg, p in rows))
    found = summarize_queries(queries, "a")[0].to_json()["metrics"]
    assert found["mean_confidence_percent"] == pytest.approx(100 * 2.05 / 4)
    assert found["ece_percent"] == pytest.approx(100 * (0.05 + 0.15 + 0.25 + 0.0) / 4)
    assert found["aurc_percent"] == pytest.approx(100 * (0 + 0 + 1 / 3 + 2 / 4) / 4)


def test_no_probabilities_are_no_calibration():
    assert "ece_percent" not in summarize_queries(QUERIES, "a")[0].to_json()["metrics"]


@pytest.fixture
def install(monkeypatch):
    """Installs functions of this module as metrics of another package."""

    def offer(*names: str) -> None:
        points = [EntryPoint(name, f"{__name__}:{name}", "lodbench.metrics") for name in names]
        theirs = [PlugIn("metrics", point.name, "theirs 1.0", point) for point in points]
        monkeypatch.setattr(metrics, "installed", lambda group: (*installed(group), *theirs))

    return offer


def worst(queries):
    return {"worst_m": queries.loc[queries[ERROR[0]] < math.inf, ERROR[0]].max()}


def impostor(queries):
    return {"mask_iou": 1.0}


def usurper(queries):
    return {"2m-2deg": 100.0}


def broken(queries):
    raise KeyError("no such column")


def leaving(queries):
    raise SystemExit(3)


def test_a_metric_of_another_package_stands_beside_our_own(install):
    install("worst")
    found = summarize_queries(QUERIES, "a")[0].to_json()["metrics"]
    assert found["worst_m"] == 4.0
    assert found["mask_iou"] == pytest.approx(0.85)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("broken", "KeyError"),
        ("leaving", "SystemExit"),
        ("impostor", "another metric's"),
        ("usurper", "2m-2deg is a name of lodbench's own"),
        ("absent", "does not load"),
    ],
)
def test_a_metric_that_fails_is_left_out_and_said(install, name, said):
    install(name, "worst")
    with pytest.warns(UserWarning, match=f"metric {name} is left out: .*{said}"):
        found = summarize_queries(QUERIES, "a")[0].to_json()["metrics"]
    assert found["worst_m"] == 4.0
    assert found["mask_iou"] == pytest.approx(0.85)


def test_the_columns_that_a_metric_is_given_are_documented():
    page = (Path(__file__).parents[2] / "docs" / "plugins.md").read_text()
    table = page.partition("## A metric")[2].partition("| column | data |")[2].partition("\n\n")[0]
    firsts = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    named = [name for first in firsts for name in re.findall(r"`(\w+)`", first)]
    assert sorted(named) == sorted(COLUMNS)


@pytest.fixture(scope="module")
def honest():
    generator = random_stream(0, "calibration")
    said = generator.uniform(0, 1, 20_000)
    return said, generator.uniform(0, 1, 20_000) < said


def test_honest_probabilities_are_calibrated(honest):
    calibration = calibrate(*honest)
    assert calibration.ece < 0.015
    assert len(calibration.bins) == 10
    assert sum(b.count for b in calibration.bins) == 20_000
    # The mean of p (1 - p) over uniform p.
    assert calibration.brier == pytest.approx(1 / 6, abs=0.005)
    # Answering down to the share c has risk c / 2, the area of which is 1 / 4.
    assert calibration.aurc == pytest.approx(0.25, abs=0.01)
    for b in calibration.bins:
        assert b.low <= b.confidence <= b.high
        assert b.interval[0] - 0.02 <= b.confidence <= b.interval[1] + 0.02


def test_overconfidence_shows(honest):
    said, found = honest
    assert calibrate(np.sqrt(said), found).ece == pytest.approx(2 / 3 - 1 / 2, abs=0.01)


def test_a_wrong_order_costs_area(honest):
    said, found = honest
    assert calibrate(1 - said, found).aurc > 0.7


def test_equal_probabilities_have_no_order():
    hits = np.array([True, False, False, True])
    coverage, risk = risk_coverage(np.full(4, 0.5), hits)
    np.testing.assert_allclose(risk, 0.5)
    np.testing.assert_allclose(coverage, [0, 0.25, 0.5, 0.75, 1])


def test_risk_by_hand():
    coverage, risk = risk_coverage(np.array([0.2, 0.9, 0.6]), np.array([False, True, False]))
    np.testing.assert_allclose(risk, [0, 0, 1 / 2, 2 / 3])
    np.testing.assert_allclose(coverage, [0, 1 / 3, 2 / 3, 1])


def test_certainty_falls_into_the_last_bin():
    (only,) = calibrate([1.0, 1.0], [True, False]).bins
    assert (only.low, only.high, only.count, only.hit_share) == (0.9, 1.0, 2, 0.5)


def test_nothing_to_judge():
    calibration = calibrate([], [])
    assert calibration.bins == ()
    assert math.isnan(calibration.ece)
    assert math.isnan(calibration.aurc)


class TestRejected:
    def test_wrong_answers_below_nine_tenths_of_the_right_ones(self):
        right = np.arange(1, 11) * 0.1
        # 90 % of the right ones are kept from 0.19 on.
        given = np.array([*right, 0.18, 0.2, 0.0])
        assert share_rejected(given, np.arange(13) < 10) == pytest.approx(2 / 3)

    def test_nothing_to_say_without_right_or_wrong_ones_or_a_probability(self):
        for given, right in (([0.9], [True]), ([0.9], [False]), ([0.9, math.nan], [True, False])):
            assert math.isnan(share_rejected(np.array(given), np.array(right)))


class TestRejectable:
    def test_answers_as_sure_as_each_other_cannot_be_told_apart(self):
        assert share_rejectable(np.full(10, 0.5)) == pytest.approx(0.1)
        assert share_rejectable(np.repeat([1.0, 0.0], 5)) == 1.0
        assert math.isnan(share_rejectable(np.array([1.0])))

    def test_is_what_is_rejected_where_answers_are_right_as_often_as_they_say(self):
        generator = np.random.default_rng(7)
        given = generator.beta(1.5, 0.7, 40_000)
        right = generator.random(len(given)) < given
        assert share_rejectable(given) == pytest.approx(share_rejected(given, right), abs=0.01)
        assert 0.3 < share_rejectable(given) < 0.9
