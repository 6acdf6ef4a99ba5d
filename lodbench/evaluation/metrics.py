"""Numbers of a split beyond recall and medians: one function and one registration each; calibration.

A metric is a function from the queries of one split to numbers by name, offered under the entry point
group ``lodbench.metrics``. Its numbers stand in ``summary.json``, in CSV, and in tables by their names
(`lodbench compare --columns NAME`).
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import STOPPED, ConfigError
from lodbench.evaluation.pose_errors import PROBABILITY_THRESHOLD, hits_of
from lodbench.evaluation.statistics import Interval, wilson_interval
from lodbench.plugins import installed

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]
Hits = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ReliabilityBin:
    """The queries whose probability lies in one range.

    Attributes:
        low: Lower end of the range, inside it.
        high: Upper end, outside it unless it is 1.
        count: Queries.
        confidence: Their mean probability, in [0, 1].
        found: Share that was found, in [0, 1].
        interval: 95 % interval of that share, in [0, 1].
    """

    low: float
    high: float
    count: int
    confidence: float
    found: float
    interval: Interval


@dataclass(frozen=True, slots=True)
class Calibration:
    """How a method's probabilities compare with what it found.

    Attributes:
        bins: Of equal width from 0 to 1, empty ones left out.
        ece: Expected calibration error: mean distance of confidence and share found, over the bins,
            weighted by their queries, in [0, 1]; NaN without queries.
        brier: Mean squared distance of probability and outcome; NaN without queries.
        coverage: (N + 1,) share of queries answered as less and less sure ones are let in, 0 to 1.
        risk: (N + 1,) share of those answered that were not found.
        aurc: Area under the risk-coverage curve, in [0, 1].
    """

    bins: tuple[ReliabilityBin, ...]
    ece: float
    brier: float
    coverage: Floats
    risk: Floats
    aurc: float


def calibrate(
    probabilities: Sequence[float] | Floats, hits: Sequence[bool] | Hits, num_bins: int = 10
) -> Calibration:
    """Returns how well probabilities, (N,) in [0, 1], agree with which of N queries were localised.

    The probability of a query without an answer is 0; bins are those of the reliability diagram.
    """
    confidence, found = np.asarray(probabilities, dtype=np.float64), np.asarray(hits, dtype=np.bool_)
    bins = _bins(confidence, found, num_bins)
    coverage, risk = risk_coverage(confidence, found)
    count = len(confidence)
    error = sum(b.count * abs(b.found - b.confidence) for b in bins) / count if count else math.nan
    return Calibration(
        bins=bins,
        ece=error,
        brier=float(np.mean((confidence - found) ** 2)) if count else math.nan,
        coverage=coverage,
        risk=risk,
        aurc=float(risk[1:].mean()) if count else math.nan,
    )


def risk_coverage(probabilities: Floats, hits: Hits) -> tuple[Floats, Floats]:
    """Returns coverage and risk, (N + 1,) each, the surest queries first; the first risk is the second's.

    Queries of equal probability are let in together in no order: each stands for their mean.
    """
    order = np.argsort(-probabilities, kind="stable")
    _, group, counts = np.unique(-probabilities[order], return_inverse=True, return_counts=True)
    missed = np.bincount(group, weights=(~hits[order]).astype(np.float64), minlength=len(counts)) / counts
    share = np.arange(1, len(hits) + 1)
    risk = np.cumsum(missed[group]) / share
    first = risk[:1] if len(risk) else np.zeros(1)
    return np.concatenate([[0.0], share / max(1, len(hits))]), np.concatenate([first, risk])


def _bins(confidence: Floats, found: Hits, num_bins: int) -> tuple[ReliabilityBin, ...]:
    index = np.minimum((confidence * num_bins).astype(np.int64), num_bins - 1)
    bins = []
    for b in np.unique(index):
        mine = index == b
        low, high = wilson_interval(found[mine])
        bins.append(
            ReliabilityBin(
                low=float(b) / num_bins,
                high=float(b + 1) / num_bins,
                count=int(mine.sum()),
                confidence=float(confidence[mine].mean()),
                found=float(found[mine].mean()),
                interval=(low / 100.0, high / 100.0),
            )
        )
    return tuple(bins)


# From the queries of one split that have a truth to numbers by name, units in the names, NaN where there
# is none. A query without an answer has errors of inf and 180 deg.
Metric = Callable[["pd.DataFrame"], Mapping[str, float]]

# Names that stand for something else in a summary, a table, the leaderboard: recalls at any threshold, areas,
# intervals, spreads, and the columns themselves.
_TAKEN = re.compile(
    r"(AUC )?[\d.e+-]+m-[\d.e+-]+deg|.+ (low|high|spread|printed|of answered)|is_printed"
    r"|median_(translation_m|rotation_deg)|(hypotheses|seconds)_per_query|queries|failed"
    r"|source|rank|group|method|variant|settings|map|condition|split|protocol|tilt|segmenter|renderer|lod|seeds|evaluator"
    r"|code|table|row|run|kept apart because|notes"
)

_PARTS = ("median_horizontal_m", "median_vertical_m", "median_yaw_deg")
_CALIBRATION = ("mean_confidence_percent", "ece_percent", "aurc_percent")
# The numbers of lodbench's own metrics: every lodbench computes them.
OWN_NUMBERS = frozenset((*_PARTS, *_CALIBRATION, "mask_iou"))


def is_taken(name: str) -> bool:
    """Tells whether a number of a metric may not be called so: something of lodbench's own is."""
    return _TAKEN.fullmatch(name) is not None


def compute_metrics(queries: pd.DataFrame) -> dict[str, float]:
    """Returns the numbers of all installed metrics over the queries of one split that have a truth.

    A metric that fails is left out with a warning: the run's other numbers stand.
    """
    numbers: dict[str, float] = {}
    for name, metric in installed_metrics().items():
        try:
            found = {str(key): float(value) for key, value in metric(queries).items()}
        except STOPPED:
            raise
        except BaseException as error:  # whatever a plug-in's own code raises
            warnings.warn(f"metric {name} is left out: {type(error).__name__}: {error}", stacklevel=2)
            continue
        if twice := sorted(found.keys() & numbers.keys()):
            warnings.warn(f"metric {name} is left out: {twice[0]} is another metric's", stacklevel=2)
            continue
        if taken := sorted(filter(is_taken, found)):
            warnings.warn(f"metric {name} is left out: {taken[0]} is a name of lodbench's own", stacklevel=2)
            continue
        numbers |= found
    return numbers


def installed_metrics() -> dict[str, Metric]:
    """Returns the installed metrics by name, our own first; a broken one is left out with a warning."""
    metrics: dict[str, Metric] = {}
    for plug_in in installed("metrics"):
        try:
            metrics.setdefault(plug_in.name, plug_in.load())
        except ConfigError as error:
            warnings.warn(f"metric {plug_in.name} is left out: {error.message}", stacklevel=3)
    return metrics


def error_parts(queries: pd.DataFrame) -> dict[str, float]:
    """Returns medians of the error along the ground, and of the sizes of those of height and yaw."""
    parts = queries[["horizontal_error_m", "vertical_error_m", "yaw_error_deg"]].abs().median()
    return dict(zip(_PARTS, map(float, parts), strict=True))


def mask_iou(queries: pd.DataFrame) -> dict[str, float]:
    """Returns the mean IoU of the query masks with the model's silhouette at the truth (paper, Table 4)."""
    return {"mask_iou": float(queries["mask_iou"].mean())}


def calibration(queries: pd.DataFrame) -> dict[str, float]:
    """Returns how a method's probabilities of being within (2 m, 2 deg) compare with what it found, percent.

    The mean probability, the expected calibration error (Guo et al. 2017, ten bins) and the area under
    the risk-coverage curve (Geifman and El-Yaniv 2017); NaN where the method gives no probability. A
    query without an answer is one that the method declined: its probability is 0.
    """
    if queries["probability"].isna().all():
        return dict.fromkeys(_CALIBRATION, math.nan)
    confidence = queries["probability"].fillna(0.0).to_numpy()
    errors = queries[["translation_error_m", "rotation_error_deg"]].to_numpy()
    found = calibrate(confidence, hits_of(errors, PROBABILITY_THRESHOLD))
    return dict(
        zip(
            _CALIBRATION,
            (100.0 * float(confidence.mean()), 100.0 * found.ece, 100.0 * found.aurc),
            strict=True,
        )
    )


@dataclass(frozen=True, slots=True)
class InstanceMatches:
    """How buildings that were found go with those that are there; sums over photos are `+`."""

    matched: int = 0
    iou_sum: float = 0.0
    found: int = 0
    true: int = 0

    def __add__(self, other: InstanceMatches) -> InstanceMatches:
        return InstanceMatches(
            self.matched + other.matched,
            self.iou_sum + other.iou_sum,
            self.found + other.found,
            self.true + other.true,
        )

    @property
    def recognition(self) -> float:
        """Returns the share of pairs among all, RQ, which is the F1 at IoU one half; NaN of nothing."""
        either = self.found + self.true
        return 2 * self.matched / either if either else float("nan")

    @property
    def segmentation(self) -> float:
        """Returns the mean IoU of pairs, SQ; NaN where there is none."""
        return self.iou_sum / self.matched if self.matched else float("nan")

    @property
    def panoptic(self) -> float:
        """Returns PQ, the product of both; NaN of nothing."""
        return 2 * self.iou_sum / (self.found + self.true) if self.found + self.true else float("nan")


def match_instances(found: NDArray[np.integer], true: NDArray[np.integer], least_px: int) -> InstanceMatches:
    """Returns how labels of a photo, (H, W) and 0 for no building, go with the true ones.

    Buildings of fewer pixels than ``least_px`` do not count, on either side.
    """
    found_ids, a, of_found = np.unique(found, return_inverse=True, return_counts=True)
    true_ids, b, of_true = np.unique(true, return_inverse=True, return_counts=True)
    shared = np.zeros((len(found_ids), len(true_ids)))
    np.add.at(shared, (a.ravel(), b.ravel()), 1)
    counted_found = (found_ids > 0) & (of_found >= least_px)
    counted_true = (true_ids > 0) & (of_true >= least_px)
    iou = shared / (of_found[:, None] + of_true[None] - shared)
    pairs = iou[counted_found][:, counted_true]
    is_pair = pairs > 0.5
    return InstanceMatches(
        int(is_pair.sum()), float(pairs[is_pair].sum()), int(counted_found.sum()), int(counted_true.sum())
    )
