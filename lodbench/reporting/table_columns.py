"""What is shown of a split: columns of recalls, errors and costs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from lodbench.reporting.cells import SplitCells
from lodbench.reporting.safe_text import plain_text


class Column(NamedTuple):
    """What is shown of a split: the head, the text of a cell, the number behind it, and which is better.

    Attributes:
        head: Name of the column.
        text: Makes the cell's text.
        value: The number it shows, NaN if there is none or more than one.
        better: 1 if more is better, -1 if less is, 0 if neither.
    """

    head: str
    text: Callable[[SplitCells], str]
    value: Callable[[SplitCells], float]
    better: int = 0

    def shown(self, cells: SplitCells | None) -> str:
        """Returns the text of a cell: what a paper printed where it did, a dash where there is nothing."""
        if cells is None:
            return "-"
        if cells.printed:
            return plain_text(cells.printed.get(self.head, "-"))
        return self.text(cells)


def paper_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns recalls, both medians in one cell, and the number of failures."""
    return (
        *(_recall_column(label) for label in labels),
        Column("T.e./R.e.", _medians_text, lambda cells: cells.translation_m, -1),
        Column("failed", lambda cells: str(cells.num_failed), lambda cells: float(cells.num_failed), -1),
    )


def segmenter_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns recalls and the masks' IoU, as in the paper's Table 4."""
    return *(_recall_column(label) for label in labels), _more_column("IoU", "mask_iou", ".2f", 1)


def detail_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns what the paper's layout leaves out: areas, parts of the error, cost, answered queries."""
    return (
        *(_auc_column(label) for label in labels),
        *(_answered_column(label) for label in labels[:1]),
        _more_column("horizontal m", "median_horizontal_m", ".2f", -1),
        _more_column("vertical m", "median_vertical_m", ".2f", -1),
        _more_column("yaw deg", "median_yaw_deg", ".2f", -1),
        _of("hypotheses", lambda cells: cells.hypotheses, 0, ".0f"),
        _more_column("s/query", "seconds_per_query", ".2f", -1),
    )


def interval_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns recalls with their 95 % intervals."""
    return tuple(_interval_column(label) for label in labels)


def calibration_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns the first recall beside what methods said of it, and the risk of answering all to none."""
    return (
        *(_recall_column(label) for label in labels[:1]),
        _more_column("said", "said", ".2f", 0),
        _more_column("said-found", "said_found", ".2f", -1),
        _more_column("risk area", "risk_area", ".2f", -1),
    )


def finite_text(value: float, spec: str) -> str:
    """Returns a number as text, a dash where it is not finite."""
    return format(value, spec) if math.isfinite(value) else "-"


def _recall_column(label: str) -> Column:
    return Column(
        label,
        lambda cells: _recall_text(cells, label),
        lambda cells: cells.recall.get(label, math.nan),
        1,
    )


def _interval_column(label: str) -> Column:
    return _recall_column(label)._replace(
        text=lambda cells: f"{_recall_text(cells, label)} {_bounds_text(cells, label)}".strip()
    )


def _auc_column(label: str) -> Column:
    return _of(f"AUC {label}", lambda cells: cells.auc.get(label, math.nan), 1)


def _answered_column(label: str) -> Column:
    return _of(f"{label} of answered", lambda cells: cells.answered.get(label, math.nan), 1)


def _more_column(head: str, name: str, spec: str, better: int) -> Column:
    return Column(
        head,
        lambda cells: _with_spread(cells, name, cells.more.get(name, math.nan), spec),
        lambda cells: cells.more.get(name, math.nan),
        better,
    )


def _of(head: str, value: Callable[[SplitCells], float], better: int, spec: str = ".2f") -> Column:
    return Column(head, lambda cells: _with_spread(cells, head, value(cells), spec), value, better)


def _recall_text(cells: SplitCells, label: str) -> str:
    return _with_spread(cells, label, cells.recall.get(label, math.nan))


def _bounds_text(cells: SplitCells, label: str) -> str:
    bounds = cells.interval.get(label)
    return f"[{bounds[0]:.1f}, {bounds[1]:.1f}]" if bounds else ""


def _medians_text(cells: SplitCells) -> str:
    medians = zip(("T.e.", "R.e."), (cells.translation_m, cells.rotation_deg), strict=True)
    return "/".join(_with_spread(cells, name, value) for name, value in medians)


def _with_spread(cells: SplitCells, name: str, value: float, spec: str = ".2f") -> str:
    spread = cells.spread.get(name, math.nan)
    text = finite_text(value, spec)
    return f"{text} ±{spread:{spec}}" if math.isfinite(spread) and text != "-" else text
