"""Intervals and paired tests, against slow or independent computations."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from lodbench.evaluation import pose_errors
from lodbench.evaluation.pose_errors import bootstrap_means, bootstrap_median, mcnemar, paired_medians

values = st.lists(st.floats(0, 100), min_size=2, max_size=60)


def slow_bootstrap(data: np.ndarray, statistic) -> tuple[float, float]:
    generator = np.random.default_rng(5)
    drawn = [statistic(generator.choice(data, len(data))) for _ in range(4000)]
    return tuple(np.percentile(drawn, [2.5, 97.5]))


@pytest.mark.parametrize("count", [41, 200])
def test_intervals_are_those_of_a_plain_bootstrap(count):
    data = np.random.default_rng(count).exponential(3.0, count)
    for ours, statistic in (
        (lambda values: bootstrap_means(values[:, None])[0], np.mean),
        (bootstrap_median, np.median),
    ):
        np.testing.assert_allclose(ours(data), slow_bootstrap(data, statistic), atol=0.12)


@given(values)
def test_the_interval_of_a_median_holds_it_and_does_not_depend_on_order(data):
    low, high = bootstrap_median(np.array(data))
    assert min(data) <= low <= high <= max(data)
    assert bootstrap_median(np.array(data[::-1])) == (low, high)


def test_failures_make_an_interval_open():
    low, high = bootstrap_median(np.array([1.0] * 6 + [math.inf] * 5))
    assert (low, high) == (1.0, math.inf)
    assert all(map(math.isnan, bootstrap_median(np.array([]))))
    assert all(map(math.isnan, bootstrap_means(np.zeros((0, 1)))[0]))


@pytest.mark.parametrize(("gained", "lost"), [(0, 0), (1, 0), (5, 0), (9, 2), (30, 30), (61, 40)])
def test_mcnemar_is_the_exact_binomial_test(gained, lost):
    first = np.array([False] * gained + [True] * lost + [True, False] * 20)
    second = np.array([True] * gained + [False] * lost + [True, False] * 20)
    test = mcnemar(first, second)
    discordant = gained + lost
    expected = binomtest(gained, discordant).pvalue if discordant else 1.0
    assert test.p == pytest.approx(expected)
    assert test.difference == pytest.approx(100 * (gained - lost) / (discordant + 40))
    assert test.interval[0] <= test.difference <= test.interval[1]
    assert mcnemar(second, first).difference == -test.difference


@pytest.mark.parametrize("shares", [(0.05, 0.05, 40), (0.3, 0.1, 25), (0.0, 0.2, 60), (0.5, 0.5, 12)])
def test_the_interval_of_a_difference_holds_the_true_one_in_95_of_100(shares):
    up, down, n = shares
    generator = np.random.default_rng(7)
    held = 0
    for draw in generator.random((2000, n)):
        gained, lost = draw < up, draw > 1 - down
        low, high = mcnemar(lost, gained).interval
        held += low <= 100 * (up - down) <= high
    assert held > 0.935 * 2000


def test_the_interval_of_a_difference_never_claims_certainty():
    hits = np.ones(20, dtype=bool)
    assert mcnemar(hits, hits).interval == pytest.approx((-12.6, 12.6), abs=0.1)
    low, high = mcnemar(~hits[:4], hits[:4]).interval
    assert low < 50 < high == 100.0
    assert all(map(math.isnan, mcnemar(hits[:0], hits[:0]).interval))


def test_one_query_tells_nothing():
    test = paired_medians(np.array([1.0]), np.array([3.0]))
    assert (test.difference, test.p) == (2.0, 1.0)


def test_equal_runs_do_not_differ_and_a_better_one_does():
    errors = np.random.default_rng(3).exponential(2.0, 80)
    same = paired_medians(errors, errors)
    assert (same.difference, same.interval, same.p) == (0.0, (0.0, 0.0), 1.0)
    better = paired_medians(errors, errors * 0.5)
    assert better.p < 0.001
    assert better.interval[1] < 0
    assert paired_medians(errors * 0.5, errors).difference == pytest.approx(-better.difference)


def test_under_the_null_hypothesis_small_p_values_are_rare():
    generator = np.random.default_rng(11)
    ps = [paired_medians(*generator.exponential(2.0, (2, 30))).p for _ in range(120)]
    assert 0.0 < np.mean(np.array(ps) < 0.2) < 0.35


def test_runs_that_mostly_fail_have_no_difference_to_tell():
    lost = np.full(5, math.inf)
    test = paired_medians(lost, lost)
    assert math.isnan(test.difference)
    assert math.isnan(test.p)
    assert paired_medians(lost, np.ones(5)).difference == -math.inf


def test_the_same_intervals_whether_resamples_are_drawn_at_once_or_in_parts(monkeypatch):
    """Of 100,000 queries all at once would take gigabytes."""
    first, second = np.random.default_rng(3).exponential(size=(2, 37))

    def measured():
        pose_errors._median_ranks.cache_clear()
        table = np.column_stack([first, second])
        means, ratio = pose_errors.bootstrap_means(table), pose_errors.bootstrap_ratio(first, second)
        return [
            *means,
            ratio,
            pose_errors.bootstrap_median(first),
            pose_errors.paired_medians(first, second)[1],
        ]

    whole = measured()
    drawn = []
    make = pose_errors._drawn
    monkeypatch.setattr(pose_errors, "_drawn", lambda g, r, n: drawn.append(r) or make(g, r, n))
    monkeypatch.setattr(pose_errors, "_AT_ONCE", 300 * 37)
    np.testing.assert_allclose(measured(), whole, rtol=1e-12)
    assert set(drawn) == {300, 100}
    pose_errors._median_ranks.cache_clear()
