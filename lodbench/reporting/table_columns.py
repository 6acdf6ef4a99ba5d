"""What is shown of a split: columns of recalls, errors, costs and metrics."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

from lodbench.errors import ConfigError, nearest_names
from lodbench.reporting.aligned_text import plain_text


class Column(NamedTuple):
    """What is shown of a split.

    Attributes:
        head: Name of the column.
        numbers: Names of the numbers in a cell; more than one are parted by a slash.
        spec: How they are written.
        better: 1 if more is better, -1 if less is, 0 if neither.
        has_bounds: Whether the 95 % interval stands behind the number.
    """

    head: str
    numbers: tuple[str, ...]
    spec: str = ".2f"
    better: int = 0
    has_bounds: bool = False

    def value(self, row: Mapping[str, Any]) -> float:
        """Returns the first number, NaN where there is none: what rows are sorted by."""
        return self.values(row)[0]

    def values(self, row: Mapping[str, Any]) -> tuple[float, ...]:
        """Returns its numbers, NaN for those that are not there."""
        found = (row.get(name) for name in self.numbers)
        return tuple(math.nan if value is None else float(value) for value in found)

    def text(self, row: Mapping[str, Any] | None) -> str:
        """Returns a cell: what a paper printed where it did, a dash where there is nothing."""
        if row is None:
            return "-"
        if row.get("is_printed") is True:
            printed = row.get(f"{self.head} printed")
            return plain_text(printed) if isinstance(printed, str) else "-"
        text = "/".join(self._number(row, name) for name in self.numbers)
        low, high = (row.get(f"{self.numbers[0]} {end}", math.nan) for end in ("low", "high"))
        low_text, high_text = (
            finite_text(end, ".1f" if self.better > 0 else self.spec) for end in (low, high)
        )
        return f"{text} [{low_text}, {high_text}]" if self.has_bounds and math.isfinite(low) else text

    def _number(self, row: Mapping[str, Any], name: str) -> str:
        text = finite_text(row.get(name, math.nan), self.spec)
        spread = row.get(f"{name} spread", math.nan)
        has_spread = math.isfinite(spread) and text != "-"
        return f"{text} ±{finite_text(spread, self.spec)}" if has_spread else text


_SHARES = re.compile(r"(horizontal)_[\d.]+m_percent|beyond_[\d.]+m_[\d.]+deg_percent")
# A count as it is, and a mean of counts to one digit: none of five runs' failures is rounded away.
_COUNT = "count"


def finite_text(value: float | None, spec: str) -> str:
    """Returns a number as text, a dash where it is not finite."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{round(value, 1):.10g}" if spec == _COUNT else format(value, spec)


def paper_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns recalls, both medians in one cell, and the number of failures."""
    medians = Column("T.e./R.e.", ("median_translation_m", "median_rotation_deg"), better=-1)
    return *_recalls(labels), medians, Column("failed", ("failed",), _COUNT, -1)


def protocol_columns(numbers: Sequence[str]) -> tuple[Column, ...]:
    """Returns the shares that only some protocols have: within a distance in plan, and beyond all bins."""
    return tuple(
        Column(name.removesuffix("_percent").replace("_", " "), (name,), better=1 if match[1] else -1)
        for name in numbers
        if (match := _SHARES.fullmatch(name))
    )


def segmenter_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns recalls and the masks' IoU, as in the paper's Table 4."""
    return *_recalls(labels), Column("IoU", ("mask_iou",), better=1)


def detail_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns what the paper's layout leaves out: areas, parts of the error, cost, answered queries."""
    return (
        *_areas(labels),
        *(Column(f"{label} of answered", (f"{label} of answered",), better=1) for label in labels[:1]),
        Column("horizontal m", ("median_horizontal_m",), better=-1),
        Column("vertical m", ("median_vertical_m",), better=-1),
        Column("yaw deg", ("median_yaw_deg",), better=-1),
        Column("hypotheses", ("hypotheses_per_query",), ".0f"),
        Column("s/query", ("seconds_per_query",), better=-1),
    )


def interval_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns recalls, their areas and both medians with their 95 % intervals."""
    columns = (
        *_recalls(labels),
        *_areas(labels),
        Column("T.e.", ("median_translation_m",), better=-1),
        Column("R.e.", ("median_rotation_deg",), better=-1),
    )
    return tuple(column._replace(has_bounds=True) for column in columns)


def calibration_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns the first recall beside the method's own confidence, ECE and AURC, percent."""
    return (
        *_recalls(labels[:1]),
        Column("mean_confidence", ("mean_confidence_percent",)),
        Column("ece", ("ece_percent",), better=-1),
        Column("aurc", ("aurc_percent",), better=-1),
    )


def metric_columns(names: Collection[str]) -> tuple[Column, ...]:
    """Returns a column of each metric of a plug-in, by name."""
    return tuple(Column(name, (name,)) for name in sorted(names))


COLUMNS: dict[str, Callable[[Sequence[str]], tuple[Column, ...]]] = {
    "calibration": calibration_columns,
    "paper": paper_columns,
    "details": detail_columns,
    "intervals": interval_columns,
    "segmenter": segmenter_columns,
}


def columns_named(name: str, labels: Sequence[str], numbers: Sequence[str]) -> tuple[Column, ...]:
    """Returns the columns of a group in ``COLUMNS``, or the one of a number by its name, a metric's perhaps.

    Raises:
        ConfigError: There is neither.
    """
    if name in COLUMNS:
        return COLUMNS[name](labels)
    if name in numbers:
        return (Column(name, (name,)),)
    raise ConfigError(f"There are no columns {name!r}.", nearest_names(name, [*COLUMNS, *numbers]))


def _recalls(labels: Sequence[str]) -> list[Column]:
    return [Column(label, (label,), better=1) for label in labels]


def _areas(labels: Sequence[str]) -> list[Column]:
    return [Column(f"AUC {label}", (f"AUC {label}",), better=1) for label in labels]
