"""How sure a number is, and whether two runs differ: intervals by query, and paired tests.

Recalls get Wilson intervals, differences of recalls those of Bonett and Price: a bootstrap of shares that
are 0 or 1, or of two runs that find the same queries, collapses to a point and claims certainty. Medians,
their differences and areas have no such formula and get a bootstrap over queries. A fixed stream draws
it, so the same numbers give the same interval.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.storage import random_stream

Floats = NDArray[np.float64]
Interval = tuple[float, float]

RESAMPLES = 1000
_PERMUTATIONS = 1999
# As many weights, or swaps, are in memory at a time: those of 10,000 queries whole, of more in parts.
_AT_ONCE = 10_000 * RESAMPLES
# Ends of a 95 % interval.
_ENDS = (2.5, 97.5)
# Two-sided 95 % quantile of the normal distribution.
_Z = 1.959963984540054


class PairedTest(NamedTuple):
    """Whether a number differs between two runs over the same queries.

    Attributes:
        difference: Second run less the first.
        interval: 95 % interval of it.
        p: Two-sided p value.
    """

    difference: float
    interval: Interval
    p: float


class Agreement(NamedTuple):
    """How far the answers of two runs to the same queries lie apart: all there is where there is no truth.

    Attributes:
        answered: Queries that both have answered.
        within: Of these, with poses within 2 m and 2 degrees of each other.
        median_m: Median distance of the positions, metres.
        median_deg: Median angle between the directions, degrees.
        median_plan_m: Median distance along the ground, metres.
        median_height_m: Median difference in height, without its sign, metres.
    """

    answered: int
    within: int
    median_m: float
    median_deg: float
    median_plan_m: float
    median_height_m: float


class Comparison(NamedTuple):
    """One number of two runs on one split."""

    split: str
    name: str
    unit: str
    first: float
    second: float
    test: PairedTest


def wilson_interval(hits: NDArray[np.bool_]) -> Interval:
    """Returns the 95 % Wilson score interval of the mean of (N,) hits, percent; NaN for none.

    Unlike a bootstrap it does not collapse to a point when all queries, or none, are found.
    """
    n = len(hits)
    if n == 0:
        return math.nan, math.nan
    # Written out: to import scipy.stats for it would be a quarter of what a short run takes.
    share, spread = float(hits.mean()), _Z**2 / n
    middle, half = share + 0.5 * spread, math.sqrt(spread * (share * (1.0 - share) + 0.25 * spread))
    low, high = ((middle + side * half) / (1.0 + spread) for side in (-1.0, 1.0))
    # At 0 and 100 % an end of the interval is the share itself, but for rounding.
    return 100.0 * max(0.0, min(low, share)), 100.0 * min(1.0, max(high, share))


def bootstrap_means(values: Floats) -> list[Interval]:
    """Returns the 95 % percentile interval of the mean of each column of (N, K) finite values."""
    if len(values) == 0:
        return [(math.nan, math.nan)] * values.shape[1]
    ordered = np.sort(values, axis=0)
    means = np.concatenate([weights @ ordered for weights in _weights(len(values))]) / len(values)
    return [_ends(column) for column in means.T]


def bootstrap_ratio(parts: Floats, wholes: Floats) -> Interval:
    """Returns the 95 % percentile interval of ``sum(parts) / sum(wholes)`` over (N,) pairs drawn together."""
    if len(parts) == 0:
        return math.nan, math.nan
    order = np.lexsort((wholes, parts))
    ratios = [(drawn @ parts[order]) / (drawn @ wholes[order]) for drawn in _weights(len(parts))]
    return _ends(np.concatenate(ratios))


def bootstrap_median(values: Floats) -> Interval:
    """Returns the 95 % percentile interval of the median of (N,) values, infinite ones included."""
    if len(values) == 0:
        return math.nan, math.nan
    ordered, (low, high) = np.sort(values), _median_ranks(len(values))
    return _ends(_middle(ordered[low], ordered[high]))


def mcnemar(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> PairedTest:
    """Returns the exact McNemar test of two runs' hits on the same (N,) queries, in percent points.

    Only queries that one run finds and the other does not tell anything; under the null hypothesis
    either run is as likely to be the one.
    """
    from scipy import stats

    gained, lost = int((second & ~first).sum()), int((first & ~second).sum())
    n = len(first)
    difference = 100.0 * (gained - lost) / n if n else math.nan
    p = stats.binomtest(gained, gained + lost).pvalue if gained + lost else 1.0
    return PairedTest(difference, _paired_interval(gained, lost, n), float(p))


def _paired_interval(gained: int, lost: int, n: int) -> Interval:
    """Returns the 95 % interval of a difference of paired shares (Bonett and Price 2012), percent points.

    A Wald interval after one query more has been gained and one more lost; it is always wider than 0.
    """
    if n == 0:
        return math.nan, math.nan
    up, down = (gained + 1) / (n + 2), (lost + 1) / (n + 2)
    spread = _Z * math.sqrt((up + down - (up - down) ** 2) / (n + 2))
    return 100.0 * max(-1.0, up - down - spread), 100.0 * min(1.0, up - down + spread)


def paired_medians(first: Floats, second: Floats) -> PairedTest:
    """Returns whether the medians of two runs' errors on the same (N,) queries differ.

    The interval is a bootstrap over queries; the p value comes from swapping the two errors of each
    query at random. Where both medians are infinite the difference is NaN.
    """
    if len(first) == 0:
        return PairedTest(math.nan, (math.nan, math.nan), math.nan)
    from scipy import stats

    observed = _difference(np.median(first), np.median(second))
    orders = np.argsort(first, kind="stable"), np.argsort(second, kind="stable")
    medians = []
    for values, order in zip((first, second), orders, strict=True):
        low, high = _ranks_of_median(weights[:, order] for weights in _weights(len(first)))
        medians.append(_middle(values[order][low], values[order][high]))
    resampled = np.array([_difference(a, b) for a, b in zip(*medians, strict=True)])
    if len(first) == 1:
        # One query swapped is as far apart as before.
        return PairedTest(observed, _ends(resampled), 1.0 if math.isfinite(observed) else math.nan)
    swapped = stats.permutation_test(
        (first, second),
        _median_distance,
        permutation_type="samples",
        n_resamples=_PERMUTATIONS,
        batch=None if _PERMUTATIONS * len(first) <= 2 * _AT_ONCE else max(1, _AT_ONCE // len(first)),
        vectorized=True,
        alternative="greater",
        rng=random_stream(0, "permutation", len(first)),
    )
    p = float(swapped.pvalue) if math.isfinite(observed) else math.nan
    return PairedTest(observed, _ends(resampled), p)


def _median_distance(first: Floats, second: Floats, axis: int = -1) -> Floats:
    with np.errstate(invalid="ignore"):
        apart = np.abs(np.median(second, axis=axis) - np.median(first, axis=axis))
    # Both medians infinite: no difference; one of them: further than anything.
    return np.nan_to_num(apart, nan=0.0, posinf=1e12)


def _weights(count: int) -> Iterator[Floats]:
    """Yields (R, count): how often each of ``count`` sorted queries is drawn in each of R resamples.

    All parts together are RESAMPLES, the same however they are cut.
    """
    if RESAMPLES * count <= _AT_ONCE:
        yield _all_weights(count)
        return
    generator, most = random_stream(0, "bootstrap", count), max(1, _AT_ONCE // count)
    for start in range(0, RESAMPLES, most):
        yield _drawn(generator, min(most, RESAMPLES - start), count)


@lru_cache(maxsize=8)
def _all_weights(count: int) -> Floats:
    return _drawn(random_stream(0, "bootstrap", count), RESAMPLES, count)


def _drawn(generator: np.random.Generator, resamples: int, count: int) -> Floats:
    drawn = generator.integers(count, size=(resamples, count))
    drawn += np.arange(resamples)[:, None] * count
    counts = np.bincount(drawn.ravel(), minlength=resamples * count)
    return counts.reshape(resamples, count).astype(np.float64)


@lru_cache(maxsize=8)
def _median_ranks(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns which two of ``count`` sorted values are the middle of each resample."""
    return _ranks_of_median(_weights(count))


def _ranks_of_median(parts: Iterable[Floats]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the places of the two middle ones, (R,) each, in values drawn (R, N) times each, by parts."""
    found = []
    for weights in parts:
        reached, n = np.cumsum(weights, axis=1), weights.shape[1]
        found.append([(reached <= rank).sum(axis=1) for rank in ((n - 1) // 2, n // 2)])
    low, high = np.concatenate(found, axis=1)
    return low, high


def _middle(low: Floats, high: Floats) -> Floats:
    with np.errstate(invalid="ignore"):
        return np.asarray((low + high) / 2)


def _difference(first: float, second: float) -> float:
    """Returns second less first; infinite medians of both are no difference."""
    return math.nan if math.isinf(first) and math.isinf(second) else float(second - first)


def _ends(values: Floats) -> Interval:
    if np.isnan(values).any():
        return math.nan, math.nan
    # By rank, not between ranks: between a number and infinity lies nothing.
    low, high = np.percentile(values, _ENDS, method="nearest")
    return float(low), float(high)
