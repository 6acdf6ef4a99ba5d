"""Recall: the share of queries found to within a distance and an angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lodbench.evaluation.errors import PoseError

# Raised whenever the same poses would score otherwise: results of two versions do not compare.
EVALUATOR_VERSION = 1

# Two-sided 95 % quantile of the normal distribution.
_Z = 1.959963984540054


class Threshold(NamedTuple):
    """A pose counts as found if both errors are strictly below these."""

    translation_m: float
    rotation_deg: float

    @property
    def label(self) -> str:
        """Returns ``2m-2deg``."""
        return f"{self.translation_m:g}m-{self.rotation_deg:g}deg"


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
    """

    num_queries: int
    num_failed: int
    recall: dict[str, float]
    interval: dict[str, tuple[float, float]]
    median_translation_m: float
    median_rotation_deg: float
    hypotheses_per_query: float

    def to_json(self) -> dict[str, Any]:
        """Returns a JSON object in which what is not finite is null."""
        return {
            "num_queries": self.num_queries,
            "num_failed": self.num_failed,
            "recall": self.recall,
            "recall_interval_95": {label: list(bounds) for label, bounds in self.interval.items()},
            "median_translation_m": _finite(self.median_translation_m),
            "median_rotation_deg": _finite(self.median_rotation_deg),
            "hypotheses_per_query": _finite(self.hypotheses_per_query),
        }


def summarize(
    errors: Sequence[PoseError],
    hypotheses: Sequence[int] = (),
    thresholds: Sequence[Threshold] = DEFAULT_THRESHOLDS,
) -> SplitSummary:
    """Returns the summary of one split.

    Args:
        errors: One per query of the truth list, ``FAILED`` for those without an answer.
        hypotheses: Poses scored, one number per answered query.
        thresholds: Where to measure recall.
    """
    table = np.array(errors, dtype=np.float64).reshape(-1, 2)
    found = {t.label: (table[:, 0] < t.translation_m) & (table[:, 1] < t.rotation_deg) for t in thresholds}
    return SplitSummary(
        num_queries=len(table),
        num_failed=int(np.isinf(table[:, 0]).sum()),
        recall={label: _percent(hit) for label, hit in found.items()},
        interval={label: wilson_interval(hit) for label, hit in found.items()},
        median_translation_m=float(np.median(table[:, 0])) if len(table) else math.nan,
        median_rotation_deg=float(np.median(table[:, 1])) if len(table) else math.nan,
        hypotheses_per_query=float(np.mean(hypotheses)) if len(hypotheses) else math.nan,
    )


def wilson_interval(hits: np.typing.NDArray[np.bool_]) -> tuple[float, float]:
    """Returns the 95 % Wilson score interval of the mean of (N,) hits, percent; NaN for none.

    Unlike a bootstrap it does not collapse to a point when all queries, or none, are found.
    """
    n = len(hits)
    if n == 0:
        return math.nan, math.nan
    share = float(hits.mean())
    middle = share + _Z * _Z / (2 * n)
    spread = _Z * math.sqrt(share * (1 - share) / n + _Z * _Z / (4 * n * n))
    scale = 100.0 / (1 + _Z * _Z / n)
    # At 0 and 100 % an end of the interval is the share itself, but for rounding.
    low = min(max(0.0, scale * (middle - spread)), 100.0 * share)
    return low, max(min(100.0, scale * (middle + spread)), 100.0 * share)


def _percent(hits: np.typing.NDArray[np.bool_]) -> float:
    return float(hits.mean() * 100.0) if len(hits) else math.nan


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
