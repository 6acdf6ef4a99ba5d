"""The numbers of one method on one split, from the summary of a run or of several seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from lodbench.evaluation.statistics import mean_and_spread

_MORE = ("median_horizontal_m", "median_vertical_m", "median_yaw_deg", "mask_iou", "seconds_per_query")
_CALIBRATION = ("said", "said_found", "risk_area")


@dataclass(frozen=True, slots=True)
class SplitCells:
    """One method on one split; what is not known is NaN or absent.

    Attributes:
        recall: Percent by threshold label.
        translation_m: Median error.
        rotation_deg: Median error.
        num_queries: Denominator.
        num_failed: Queries without an answer.
        hypotheses: Poses scored per query.
        printed: Cells to show in place of these numbers, by column: what a paper printed.
        interval: 95 % interval of each recall.
        answered: Recall over the answered queries alone, by label.
        auc: Area under the recall up to each label's thresholds, percent.
        more: Any other number by the name it has in ``summary.json``, and ``seconds_per_query``.
        spread: Standard deviation over seeds, by the name of a column; empty for one run.
    """

    recall: dict[str, float]
    translation_m: float
    rotation_deg: float
    num_queries: int
    num_failed: int
    hypotheses: float
    printed: dict[str, str] = field(default_factory=dict)
    interval: dict[str, tuple[float, float]] = field(default_factory=dict)
    answered: dict[str, float] = field(default_factory=dict)
    auc: dict[str, float] = field(default_factory=dict)
    more: dict[str, float] = field(default_factory=dict)
    spread: dict[str, float] = field(default_factory=dict)


def cells_of(summary: dict[str, Any]) -> SplitCells:
    """Returns the cells of one split of a ``summary.json``."""

    def number(name: str) -> float:
        value = summary.get(name)
        return math.nan if value is None else float(value)

    def numbers(name: str) -> dict[str, float]:
        return {k: math.nan if v is None else float(v) for k, v in summary.get(name, {}).items()}

    known = summary.get("calibration", {})
    bounds = summary.get("recall_interval_95", {})
    return SplitCells(
        recall=numbers("recall"),
        translation_m=number("median_translation_m"),
        rotation_deg=number("median_rotation_deg"),
        num_queries=summary["num_queries"] or 0,
        num_failed=summary["num_failed"] or 0,
        hypotheses=number("hypotheses_per_query"),
        interval={label: (low, high) for label, (low, high) in bounds.items() if low is not None},
        answered=numbers("recall_of_answered"),
        auc=numbers("auc"),
        more={name: number(name) for name in _MORE}
        | {name: float(known.get(name, math.nan)) for name in _CALIBRATION},
    )


def mean_cells(runs: Sequence[dict[str, Any]], split: str) -> SplitCells:
    """Returns the cells of one run, or the means of several with their spread."""
    cells = [cells_of(run["splits"][split]) for run in runs if split in run["splits"]]
    if len(cells) == 1:
        return cells[0]
    spread: dict[str, float] = {}

    def mean(column: str, values: Sequence[float]) -> float:
        middle, spread[column] = mean_and_spread(values)
        return middle

    first = cells[0]
    return SplitCells(
        recall={at: mean(at, [c.recall[at] for c in cells]) for at in first.recall},
        translation_m=mean("T.e.", [c.translation_m for c in cells]),
        rotation_deg=mean("R.e.", [c.rotation_deg for c in cells]),
        num_queries=first.num_queries,
        num_failed=max(c.num_failed for c in cells),
        hypotheses=mean("hypotheses", [c.hypotheses for c in cells]),
        answered={at: mean(f"{at} of answered", [c.answered[at] for c in cells]) for at in first.answered},
        auc={at: mean(f"AUC {at}", [c.auc[at] for c in cells]) for at in first.auc},
        more={name: mean(name, [c.more[name] for c in cells]) for name in first.more},
        spread=spread,
    )
