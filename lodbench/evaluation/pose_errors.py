"""Errors of poses, a split summarised by them, how sure its numbers are, and whether two runs differ.

Recalls get Wilson intervals, differences of recalls those of Bonett and Price: a bootstrap of shares that
are 0 or 1, or of two runs that find the same queries, collapses to a point and claims certainty. Medians,
their differences and areas have no such formula and get a bootstrap over queries. A fixed stream draws
it, so the same numbers give the same interval.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import Pose, wrap_deg
from lodbench.storage import random_stream

# Raised whenever the same poses would score otherwise: results of two versions do not compare.
EVALUATOR_VERSION = 1
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


class PoseError(NamedTuple):
    """Distance of the camera centres in metres, and angle of the turn between the poses in degrees."""

    translation_m: float
    rotation_deg: float


class ErrorParts(NamedTuple):
    """The same error taken apart: along the ground, up (+ is too high), in yaw (+ is too far left)."""

    horizontal_m: float
    vertical_m: float
    yaw_deg: float


class Apart(NamedTuple):
    """How far one answer to a query lies from another, measured as ``pose_error`` and ``error_parts`` do."""

    # Distance of the camera centres, metres, and angle of the turn between the poses, degrees.
    error: PoseError
    # The same taken apart: along the ground, how much higher (metres) and further left (degrees) the second
    # is than the first.
    parts: ErrorParts


# What a query without an answer counts as.
FAILED = PoseError(math.inf, 180.0)
FAILED_PARTS = ErrorParts(math.inf, math.inf, 180.0)


def pose_error(estimate: Pose, truth: Pose) -> PoseError:
    """Returns the errors of an estimate.

    The angle comes from atan2 of the turn's sine and cosine: unlike arccos of the trace it keeps
    its digits near 0.

    Example:
        >>> from lodbench.geometry import EulerAngles
        >>> truth = Pose.from_euler(EulerAngles(30, 0, 45), center=(0, 0, 100))
        >>> error = pose_error(Pose.from_euler(EulerAngles(30, 0, 47), center=(3, 4, 100)), truth)
        >>> round(error.translation_m, 6), round(error.rotation_deg, 6)
        (5.0, 2.0)
    """
    # Nine numbers are quicker as floats than as arrays, and evaluating means millions of poses.
    turn = (truth.rotation.T @ estimate.rotation).tolist()
    sine = math.hypot(turn[2][1] - turn[1][2], turn[0][2] - turn[2][0], turn[1][0] - turn[0][1])
    angle = math.atan2(sine, turn[0][0] + turn[1][1] + turn[2][2] - 1.0)
    distance_m = math.dist(estimate.center.tolist(), truth.center.tolist())
    return PoseError(distance_m, math.degrees(angle))


def apart(second: Pose, first: Pose) -> Apart:
    """Returns how far a second answer lies from a first."""
    return Apart(pose_error(second, first), error_parts(second, first))


def error_parts(estimate: Pose, truth: Pose) -> ErrorParts:
    """Returns an estimate's error along the ground, upwards and in yaw; the frame's z points up."""
    x, y, z = estimate.center - truth.center
    return ErrorParts(math.hypot(x, y), float(z), wrap_deg(estimate.euler.yaw_deg - truth.euler.yaw_deg))


class Threshold(NamedTuple):
    """A pose counts as found if both errors are strictly below these."""

    translation_m: float
    rotation_deg: float

    @property
    def label(self) -> str:
        """Returns ``2m-2deg``."""
        return f"{self.translation_m:g}m-{self.rotation_deg:g}deg"


# What a method's probability is of.
PROBABILITY_THRESHOLD = Threshold(2, 2)
DEFAULT_THRESHOLDS = (Threshold(2, 2), Threshold(3, 3), Threshold(5, 5))


@dataclass(frozen=True, slots=True)
class SplitSummary:
    """Recalls and medians over the truth list of one split; failures count as (inf, 180)."""

    num_queries: int  # length of the truth list: the denominator
    num_failed: int  # queries without an answer
    recall: dict[str, float]  # percent by threshold label
    interval: dict[str, Interval]  # 95 % interval of each recall, percent (Wilson)
    median_translation_m: float  # median over all queries
    median_rotation_deg: float  # median over all queries
    hypotheses_per_query: float  # mean over answered queries; NaN if there is none
    # Percent of the answered queries, by threshold label; NaN if there is none.
    answered_recall: dict[str, float] = field(default_factory=dict)
    # Area under the recall as both thresholds grow together from 0 to the label's, percent.
    auc: dict[str, float] = field(default_factory=dict)
    # 95 % bootstrap intervals of the two medians, by name.
    median_interval: dict[str, Interval] = field(default_factory=dict)
    auc_interval: dict[str, Interval] = field(default_factory=dict)  # 95 % bootstrap interval of each area
    # Numbers of the installed metrics by name (``lodbench.evaluation.metrics``), NaN where unknown; JSON
    # leaves these out.
    metrics: dict[str, float] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Returns a JSON object in which what is not finite is null; of metrics it is left out."""
        return {
            "num_queries": self.num_queries,
            "num_failed": self.num_failed,
            "recall": _all_finite(self.recall),
            "recall_interval_95": _bounds(self.interval),
            "median_translation_m": _finite(self.median_translation_m),
            "median_rotation_deg": _finite(self.median_rotation_deg),
            "median_interval_95": _bounds(self.median_interval),
            "recall_of_answered": _all_finite(self.answered_recall),
            "auc": _all_finite(self.auc),
            "auc_interval_95": _bounds(self.auc_interval),
            "hypotheses_per_query": _finite(self.hypotheses_per_query),
            "metrics": {name: value for name, value in self.metrics.items() if math.isfinite(value)},
        }


def summarize(
    errors: Sequence[PoseError] | NDArray[np.float64],
    hypotheses: Sequence[float] | NDArray[np.float64] = (),
    thresholds: Sequence[Threshold] = DEFAULT_THRESHOLDS,
    *,
    metrics: Mapping[str, float] | None = None,
) -> SplitSummary:
    """Returns the summary of one split.

    Args:
        errors: (N, 2) metres and degrees, one per query of the truth list, ``FAILED`` for those without an
            answer.
        hypotheses: Poses scored, one number per answered query.
        thresholds: Where to measure recall.
        metrics: Further numbers of the split by name.
    """
    table = np.array(errors, dtype=np.float64).reshape(-1, 2)
    answered = np.isfinite(table[:, 0])
    hits = {t.label: hits_of(table, t) for t in thresholds}
    areas = {t.label: _area_shares(table, t) for t in thresholds}
    columns = 100.0 * np.array(list(areas.values()), dtype=np.float64).reshape(len(areas), len(table)).T
    return SplitSummary(
        num_queries=len(table),
        num_failed=int((~answered).sum()),
        recall={label: _percent(hit) for label, hit in hits.items()},
        interval={label: wilson_interval(hit) for label, hit in hits.items()},
        median_translation_m=_median(table[:, 0]),
        median_rotation_deg=_median(table[:, 1]),
        hypotheses_per_query=float(np.mean(hypotheses)) if len(hypotheses) else math.nan,
        answered_recall={label: _percent(hit[answered]) for label, hit in hits.items()},
        auc={label: _percent(np.sort(share)) for label, share in areas.items()},
        median_interval={
            name: bootstrap_median(table[:, column])
            for column, name in enumerate(("translation_m", "rotation_deg"))
        },
        auc_interval=dict(zip(areas, bootstrap_means(columns), strict=True)),
        metrics=dict(metrics or {}),
    )


def hits_of(errors: NDArray[np.float64], threshold: Threshold) -> NDArray[np.bool_]:
    """Returns which of (N, 2) errors in metres and degrees lie strictly below a threshold."""
    return np.asarray((errors[:, 0] < threshold.translation_m) & (errors[:, 1] < threshold.rotation_deg))


def _area_shares(errors: NDArray[np.float64], threshold: Threshold) -> NDArray[np.float64]:
    """Returns each query's part of the area under the recall curve: how early it is found, 0 to 1.

    With both thresholds scaled by s from 0 to 1 a query is found from s = max(e_t / a, e_R / b) on;
    the mean of 1 - s is the exact area, without steps.
    """
    with np.errstate(all="ignore"):
        first = (errors / np.array(threshold)).max(axis=1, initial=0.0)
    shares = np.clip(1.0 - np.nan_to_num(first, nan=np.inf), 0.0, 1.0)
    return np.asarray(shares, dtype=np.float64)


def _median(values: NDArray[np.float64]) -> float:
    return float(np.median(values)) if len(values) else math.nan


def _percent(hits: NDArray[np.bool_] | NDArray[np.float64]) -> float:
    return float(hits.mean() * 100.0) if len(hits) else math.nan


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _all_finite(values: dict[str, float]) -> dict[str, float | None]:
    return {name: _finite(value) for name, value in values.items()}


def _bounds(intervals: dict[str, Interval]) -> dict[str, list[float | None]]:
    return {name: [_finite(end) for end in ends] for name, ends in intervals.items()}


class PairedTest(NamedTuple):
    """Whether a number differs between two runs over the same queries."""

    difference: float  # second run less the first
    interval: Interval  # 95 % interval of it
    p: float  # two-sided p value


class Agreement(NamedTuple):
    """How far the answers of two runs to the same queries lie apart: all there is where there is no truth."""

    answered: int  # queries that both have answered
    within: int  # of these, with poses within 2 m and 2 degrees of each other
    median_m: float  # median distance of the positions, metres
    median_deg: float  # median angle between the directions, degrees
    median_plan_m: float  # median distance along the ground, metres
    median_height_m: float  # median difference in height, without its sign, metres


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
    ranks = []
    for weights in parts:
        reached, n = np.cumsum(weights, axis=1), weights.shape[1]
        ranks.append([(reached <= rank).sum(axis=1) for rank in ((n - 1) // 2, n // 2)])
    low, high = np.concatenate(ranks, axis=1)
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
