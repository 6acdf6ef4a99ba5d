"""One row per query: what a method answered, and how far off it was."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lodbench.evaluation.errors import FAILED, FAILED_PARTS, ErrorParts, PoseError
from lodbench.evaluation.recall import DEFAULT_THRESHOLDS, SplitSummary, Threshold, summarize
from lodbench.geometry import Pose

# The reason of a row that cannot be scored: it is not part of the truth list.
NO_TRUTH = "no true pose to compare with"


def is_without_truth(failure: str) -> bool:
    """Tells whether a row's reason is that nothing is known to compare with: it is in no denominator."""
    return failure.startswith(NO_TRUTH)


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
        parts: The estimate's error taken apart; ``FAILED_PARTS`` without one, None without a truth.
        mask_iou: IoU of the query mask with the model's silhouette at the truth, or None.
        probability: What the method said of its being within 2 m and 2 degrees, or None.
        covariance: Upper triangle, row by row (21 numbers), of its error's covariance in x, y, z (metres),
            pitch, roll and yaw (degrees); empty where the method tells none.
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
    parts: ErrorParts | None = None
    mask_iou: float | None = None
    probability: float | None = None
    covariance: tuple[float, ...] = ()

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
    scored = [row for row in mine if row.error is not None]
    # Rows of another source than a run may not have their errors taken apart.
    is_apart = all(row.parts is not None for row in scored)
    return (
        summarize(
            estimates,
            hypotheses,
            thresholds,
            parts=[row.parts or FAILED_PARTS for row in scored] if is_apart else (),
            mask_ious=[row.mask_iou for row in mine if row.mask_iou is not None],
            probabilities=[row.probability for row in scored],
        ),
        summarize(priors, (), thresholds),
    )


def seconds_per_query(rows: Sequence[QueryRow], split: str) -> float:
    """Returns the mean wall time of a split's answered queries, NaN if there is none."""
    times = [sum(row.seconds.values()) for row in rows if row.split == split and row.is_answered]
    return sum(times) / len(times) if times else math.nan
