"""Numbers of a split beyond recall and medians: one function and one registration each.

A metric is a function from the queries of one split to numbers by name, offered under the entry point
group ``lodbench.metrics``. Its numbers stand in ``summary.json``, in CSV, and in tables by their names
(`lodbench compare --columns NAME`).
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import STOPPED, ConfigError
from lodbench.evaluation.calibration import calibrate
from lodbench.evaluation.recall import PROBABILITY_THRESHOLD, hits_of
from lodbench.plugins import installed

if TYPE_CHECKING:
    import pandas as pd

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
    """Returns how labels of a photo go with the true ones.

    Args:
        found: (H, W), 0 for no building.
        true: (H, W), likewise.
        least_px: Buildings of fewer pixels do not count, on either side.
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
