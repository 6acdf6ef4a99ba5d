"""Recall: the share of queries found to within a distance and an angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.evaluation.calibration import calibrate
from lodbench.evaluation.errors import ErrorParts, PoseError
from lodbench.evaluation.statistics import Interval, bootstrap_means, bootstrap_median, wilson_interval

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
        median_horizontal_m: Median distance along the ground.
        median_vertical_m: Median of the height error's size.
        median_yaw_deg: Median of the yaw error's size.
        mask_iou: Mean IoU of the query masks with the model's silhouette at the truth; NaN if unknown.
        said: Mean probability of being within (2 m, 2 deg) that the method gave, percent; NaN if none.
        said_found: Mean distance of these probabilities from what was found, over the bins of a
            reliability diagram, percent.
        risk_area: Area under the risk over the coverage, percent.
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
    median_horizontal_m: float = math.nan
    median_vertical_m: float = math.nan
    median_yaw_deg: float = math.nan
    mask_iou: float = math.nan
    said: float = math.nan
    said_found: float = math.nan
    risk_area: float = math.nan

    def to_json(self) -> dict[str, Any]:
        """Returns a JSON object in which what is not finite is null; ``calibration`` only where known."""
        known = {"said": self.said, "said_found": self.said_found, "risk_area": self.risk_area}
        calibration = {"calibration": known} if math.isfinite(self.said) else {}
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
            "median_horizontal_m": _finite(self.median_horizontal_m),
            "median_vertical_m": _finite(self.median_vertical_m),
            "median_yaw_deg": _finite(self.median_yaw_deg),
            "mask_iou": _finite(self.mask_iou),
            "hypotheses_per_query": _finite(self.hypotheses_per_query),
            **calibration,
        }


def summarize(
    errors: Sequence[PoseError],
    hypotheses: Sequence[int] = (),
    thresholds: Sequence[Threshold] = DEFAULT_THRESHOLDS,
    *,
    parts: Sequence[ErrorParts] = (),
    mask_ious: Sequence[float] = (),
    probabilities: Sequence[float | None] = (),
) -> SplitSummary:
    """Returns the summary of one split.

    Args:
        errors: One per query of the truth list, ``FAILED`` for those without an answer.
        hypotheses: Poses scored, one number per answered query.
        thresholds: Where to measure recall.
        parts: The same errors taken apart, ``FAILED_PARTS`` for those without an answer; or none.
        mask_ious: IoU of each query mask that there is.
        probabilities: One per error: what the method said of its being within (2 m, 2 deg), None if nothing;
            or none at all.
    """
    table = np.array(errors, dtype=np.float64).reshape(-1, 2)
    answered = np.isfinite(table[:, 0])
    found = {t.label: hits_of(table, t) for t in thresholds}
    areas = {t.label: _area_shares(table, t) for t in thresholds}
    columns = 100.0 * np.array(list(areas.values()), dtype=np.float64).reshape(len(areas), len(table)).T
    said, said_found, risk_area = _calibration(table, probabilities)
    sizes = np.abs(np.array(parts, dtype=np.float64).reshape(-1, 3))
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
        median_horizontal_m=_median(sizes[:, 0]),
        median_vertical_m=_median(sizes[:, 1]),
        median_yaw_deg=_median(sizes[:, 2]),
        mask_iou=float(np.mean(mask_ious)) if len(mask_ious) else math.nan,
        said=said,
        said_found=said_found,
        risk_area=risk_area,
    )


def hits_of(errors: NDArray[np.float64], threshold: Threshold) -> NDArray[np.bool_]:
    """Returns which of (N, 2) errors in metres and degrees lie strictly below a threshold."""
    return np.asarray((errors[:, 0] < threshold.translation_m) & (errors[:, 1] < threshold.rotation_deg))


def _calibration(
    errors: NDArray[np.float64], probabilities: Sequence[float | None]
) -> tuple[float, float, float]:
    """Returns what was said, its distance from what was found, and the risk's area, percent; or NaN."""
    if all(probability is None for probability in probabilities):
        return math.nan, math.nan, math.nan
    # A query without an answer is one the method declined.
    said = [probability or 0.0 for probability in probabilities]
    calibration = calibrate(said, hits_of(errors, PROBABILITY_THRESHOLD).tolist())
    return (
        100.0 * float(np.mean(said)),
        100.0 * calibration.calibration_error,
        100.0 * calibration.risk_area,
    )


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
