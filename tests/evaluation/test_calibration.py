"""Calibration against answers whose true probabilities are known."""

import math

import numpy as np
import pytest

from lodbench.evaluation.metrics import calibrate, risk_coverage
from lodbench.storage import random_stream


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
    assert (only.low, only.high, only.count, only.found) == (0.9, 1.0, 2, 0.5)


def test_nothing_to_judge():
    calibration = calibrate([], [])
    assert calibration.bins == ()
    assert math.isnan(calibration.ece)
    assert math.isnan(calibration.aurc)
