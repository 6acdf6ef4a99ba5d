"""Errors of poses, and a split summarised by them: recall within thresholds, medians, areas, intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.evaluation.statistics import Interval, bootstrap_means, bootstrap_median, wilson_interval
from lodbench.geometry import Pose, wrap_deg


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
    """How far one answer to a query lies from another, as ``pose_error`` and ``error_parts`` measure errors.

    Attributes:
        error: Distance of the camera centres, metres, and angle of the turn between the poses, degrees.
        parts: The same taken apart: along the ground, how much higher (metres) and further left (degrees)
            the second is than the first.
    """

    error: PoseError
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


# Raised whenever the same poses would score otherwise: results of two versions do not compare.
EVALUATOR_VERSION = 1


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
    """Recalls and medians over the truth list of one split; failures count as (inf, 180).

    Attributes:
        num_queries: Length of the truth list: the denominator.
        num_failed: Queries without an answer.
        recall: Percent by threshold label.
        interval: 95 % interval of each recall, percent (Wilson).
        median_translation_m: Median over all queries.
        median_rotation_deg: Median over all queries.
        hypotheses_per_query: Mean over answered queries; NaN if there is none.
        answered_recall: Percent of the answered queries, by threshold label; NaN if there is none.
        auc: Area under the recall as both thresholds grow together from 0 to the label's, percent.
        median_interval: 95 % bootstrap intervals of the two medians, by name.
        auc_interval: 95 % bootstrap interval of each area.
        metrics: Numbers of the installed metrics by name (``lodbench.evaluation.metrics``), NaN where
            unknown; JSON leaves these out.
    """

    num_queries: int
    num_failed: int
    recall: dict[str, float]
    interval: dict[str, Interval]
    median_translation_m: float
    median_rotation_deg: float
    hypotheses_per_query: float
    answered_recall: dict[str, float] = field(default_factory=dict)
    auc: dict[str, float] = field(default_factory=dict)
    median_interval: dict[str, Interval] = field(default_factory=dict)
    auc_interval: dict[str, Interval] = field(default_factory=dict)
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
    found = {t.label: hits_of(table, t) for t in thresholds}
    areas = {t.label: _area_shares(table, t) for t in thresholds}
    columns = 100.0 * np.array(list(areas.values()), dtype=np.float64).reshape(len(areas), len(table)).T
    return SplitSummary(
        num_queries=len(table),
        num_failed=int((~answered).sum()),
        recall={label: _percent(hit) for label, hit in found.items()},
        interval={label: wilson_interval(hit) for label, hit in found.items()},
        median_translation_m=_median(table[:, 0]),
        median_rotation_deg=_median(table[:, 1]),
        hypotheses_per_query=float(np.mean(hypotheses)) if len(hypotheses) else math.nan,
        answered_recall={label: _percent(hit[answered]) for label, hit in found.items()},
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
