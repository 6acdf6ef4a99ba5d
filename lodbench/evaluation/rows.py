"""One row per query: what a method answered, and how far off it was."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lodbench.evaluation.errors import FAILED, PoseError
from lodbench.evaluation.recall import DEFAULT_THRESHOLDS, SplitSummary, Threshold, summarize
from lodbench.geometry import Pose

# The reason of a row that cannot be scored: it is not part of the truth list.
NO_TRUTH = "no true pose to compare with"


@dataclass(frozen=True, slots=True, eq=False)
class QueryRow:
    """The outcome of one query.

    Attributes:
        name: Image file name.
        split: Name of the split.
        pose: Estimate in the dataset's frame, or None.
        score: The method's score, or None.
        hypotheses: Poses rendered and compared; None where that is not known.
        failure: Why there is no estimate, or "".
        error: Error of the estimate; ``FAILED`` without one, None where there is no truth.
        prior_error: Error of the prior, likewise.
        seconds: Wall time by stage.
    """

    name: str
    split: str
    pose: Pose | None
    score: float | None
    hypotheses: int | None
    failure: str
    error: PoseError | None
    prior_error: PoseError | None
    seconds: dict[str, float]

    @property
    def key(self) -> str:
        """Returns ``split/name``."""
        return f"{self.split}/{self.name}"

    @property
    def is_answered(self) -> bool:
        """Tells whether there is an estimate."""
        return self.pose is not None


def summarize_rows(
    rows: Sequence[QueryRow], split: str, thresholds: Sequence[Threshold] = DEFAULT_THRESHOLDS
) -> tuple[SplitSummary, SplitSummary]:
    """Returns the summaries of the estimates and of the priors of one split, over its truth list."""
    mine = [row for row in rows if row.split == split]
    estimates = [row.error for row in mine if row.error is not None]
    priors = [row.prior_error or FAILED for row in mine if row.error is not None]
    hypotheses = [row.hypotheses for row in mine if row.is_answered and row.hypotheses is not None]
    return summarize(estimates, hypotheses, thresholds), summarize(priors, (), thresholds)


def seconds_per_query(rows: Sequence[QueryRow], split: str) -> float:
    """Returns the mean wall time of a split's answered queries, NaN if there is none."""
    times = [sum(row.seconds.values()) for row in rows if row.split == split and row.is_answered]
    return sum(times) / len(times) if times else math.nan
