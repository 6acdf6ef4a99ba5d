"""The model of a recall table: methods by splits, from summaries of runs; formats are elsewhere."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from lodbench.errors import DatasetError
from lodbench.evaluation.statistics import mean_and_spread


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


class TableRow(NamedTuple):
    """A line of a table.

    Attributes:
        label: The method, or its variant where ``group`` names the method.
        cells: By split.
        group: What lines next to each other have in common: ``method | map``, or "".
    """

    label: str
    cells: dict[str, SplitCells]
    group: str = ""


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


@dataclass(frozen=True, slots=True)
class RecallTable:
    """Rows of methods over columns of splits.

    Attributes:
        title: What the rows have in common: dataset, tilt, segmenter, seed.
        splits: Names, left to right.
        rows: Top to bottom; the priors' first, where there is one.
        columns: Columns of each split; empty for the paper's.
    """

    title: str
    splits: tuple[str, ...]
    rows: tuple[TableRow, ...]
    columns: tuple[Column, ...] = ()

    def labels(self) -> list[str]:
        """Returns the threshold labels of the first row that has any."""
        return next((list(cells.recall) for row in self.rows for cells in row.cells.values()), [])

    def shown(self) -> tuple[Column, ...]:
        """Returns the columns of each split."""
        return self.columns or paper_columns(self.labels())


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


def read_summary(folder: Path) -> dict[str, Any]:
    """Returns the summary of a run folder, with the times that ``provenance.json`` holds.

    Raises:
        DatasetError: The folder holds no readable summary, or one of another version of lodbench.
    """
    path = folder / "summary.json"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{path} is not a readable run summary.", "Name a folder that `lodbench run` made."
        ) from error
    if not isinstance(summary, dict) or "splits" not in summary or "protocol" not in summary:
        raise DatasetError(f"{path} is not a run summary.")
    if summary.get("schema") != SUMMARY_SCHEMA:
        raise DatasetError(
            f"{path} has schema {summary.get('schema')}, this lodbench writes and reads {SUMMARY_SCHEMA}.",
            "Run again: the same command resumes nothing of another version, and ranks with nothing of it.",
        )
    if summary.get("invalid"):
        raise DatasetError(f"The run {folder} is invalid: {summary['invalid']}.", "It can enter no table.")
    return summary


# Raised whenever a number of a summary gets another meaning, or a new one must be there.
SUMMARY_SCHEMA = 2


def with_seconds(summary: dict[str, Any], seconds: dict[str, float | None]) -> dict[str, Any]:
    """Returns a summary whose splits also hold the wall time per query: no part of the summary's file."""
    splits = {
        name: {**split, "seconds_per_query": seconds.get(name)} for name, split in summary["splits"].items()
    }
    return {**summary, "splits": splits}


def tables_of(
    summaries: Sequence[dict[str, Any]], free: Collection[str] = (), over_seeds: bool = False
) -> list[RecallTable]:
    """Returns one table per protocol (dataset, tilt, segmenter, seed), the priors' row on top of each.

    Runs over other queries, masks or another city never share a table, whatever their names.

    Args:
        summaries: ``summary.json`` of each run.
        free: Parts of the protocol that may differ within a table: its rows then say which they have.
        over_seeds: Whether runs that differ in their seed alone become one row, mean and spread.
    """
    free = {*free, "seed"} if over_seeds else set(free)
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for summary in summaries:
        inputs = [str(summary["dataset"].get(name, "")) for name in _fixed_inputs(free)]
        renderer = "" if "renderer" in free else str(summary["protocol"].get("renderer", ""))
        groups.setdefault((title_of(summary, free), renderer, *inputs), []).append(summary)
    return [_table(title, members, free, over_seeds) for (title, *_), members in groups.items()]


def title_of(summary: dict[str, Any], free: Collection[str] = ()) -> str:
    """Returns what a run's table is headed with: everything that must agree to compare rows."""
    dataset, protocol = summary["dataset"], summary["protocol"]
    version = f" ({dataset['version']})" if dataset.get("version") else ""
    lod = f" · LoD{protocol['lod']}" if protocol.get("lod") and "lod" not in free else ""
    words = [f"{name}={protocol[name]}" for name in ("tilt", "segmenter", "seed") if name not in free]
    drawn = protocol.get("prior", "file")
    if drawn != "file" and "prior" not in free:
        words.append(f"priors {drawn}")
    return " · ".join([f"{dataset['name']}{version}{lod}", *words])


def cells_of(summary: dict[str, Any]) -> SplitCells:
    """Returns the cells of one split of a ``summary.json``."""

    def number(name: str) -> float:
        value = summary.get(name)
        return math.nan if value is None else float(value)

    def numbers(name: str) -> dict[str, float]:
        return {k: math.nan if v is None else float(v) for k, v in summary.get(name, {}).items()}

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
        more={name: number(name) for name in _MORE},
    )


_MORE = ("median_horizontal_m", "median_vertical_m", "median_yaw_deg", "mask_iou", "seconds_per_query")


def finite_text(value: float, spec: str) -> str:
    """Returns a number as text, a dash where it is not finite."""
    return format(value, spec) if math.isfinite(value) else "-"


def _fixed_inputs(free: Collection[str]) -> list[str]:
    """Returns the digests that must agree: another level is another scene, another segmenter other masks."""
    names = ["queries"]
    names += [] if "lod" in free else ["scene"]
    return names + ([] if "segmenter" in free else ["masks"])


def _table(title: str, members: list[dict[str, Any]], free: set[str], over_seeds: bool) -> RecallTable:
    splits = tuple(dict.fromkeys(split for member in members for split in member["splits"]))
    rows = []
    priors = [member["prior"] for member in members]
    if all(prior == priors[0] for prior in priors):
        rows.append(TableRow("Prior", {split: cells_of(value) for split, value in priors[0].items()}))
    labelled: dict[str, list[dict[str, Any]]] = {}
    labels = _labels(members, free - {"seed"} if over_seeds else free)
    for label, member in zip(labels, members, strict=True):
        labelled.setdefault(label if over_seeds else f"{label}\0{len(labelled)}", []).append(member)
    found = []
    for label, runs in labelled.items():
        shown = label.split("\0")[0] + (f" ({len(runs)} seeds)" if over_seeds else "")
        found.append(TableRow(shown, {name: _over_seeds(runs, name) for name in runs[0]["splits"]}))
    if len({_name(member) for member in members}) == 1:
        # One method under several settings: in their order, whatever the order of the folders.
        found.sort(key=lambda row: _natural(row.label))
    return RecallTable(title, splits, tuple([*rows, *found]))


def _natural(text: str) -> list[tuple[float, str]]:
    """Returns what sorts steps=5 before steps=10."""
    words = re.split(r"(\d+(?:\.\d+)?)", text)
    return [(float(word), "") if number % 2 else (0.0, word) for number, word in enumerate(words)]


def _name(member: dict[str, Any]) -> str:
    method = member["method"]
    return " ".join(filter(None, [method["name"], method.get("variant", "").replace("_", " ")]))


def _labels(members: Sequence[dict[str, Any]], free: Collection[str]) -> list[str]:
    """Returns a name for each run: method, variant, and whatever else differs between runs of that method."""
    names = [_name(member) for member in members]
    labels = []
    for member, name in zip(members, names, strict=True):
        peers = [other for other, theirs in zip(members, names, strict=True) if theirs == name]
        params = member["method"].get("params", {})
        differing = [
            key for key in params if any(p["method"].get("params", {}).get(key) != params[key] for p in peers)
        ]
        words = [f"{key}={params[key]}" for key in differing]
        words += [f"{key}={member['protocol'].get(key)}" for key in sorted(free)]
        labels.append(" ".join([name, *words]))
    return labels


def _over_seeds(runs: Sequence[dict[str, Any]], split: str) -> SplitCells:
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


def _recall_text(cells: SplitCells, label: str) -> str:
    return _with_spread(cells, label, cells.recall.get(label, math.nan))


def _bounds_text(cells: SplitCells, label: str) -> str:
    bounds = cells.interval.get(label)
    return f"[{bounds[0]:.1f}, {bounds[1]:.1f}]" if bounds else ""


def _medians_text(cells: SplitCells) -> str:
    medians = zip(("T.e.", "R.e."), (cells.translation_m, cells.rotation_deg), strict=True)
    return "/".join(_with_spread(cells, name, value) for name, value in medians)


def _of(head: str, value: Callable[[SplitCells], float], better: int, spec: str = ".2f") -> Column:
    return Column(head, lambda cells: _with_spread(cells, head, value(cells), spec), value, better)


def _more_column(head: str, name: str, spec: str, better: int) -> Column:
    return Column(
        head,
        lambda cells: _with_spread(cells, name, cells.more.get(name, math.nan), spec),
        lambda cells: cells.more.get(name, math.nan),
        better,
    )


def _with_spread(cells: SplitCells, name: str, value: float, spec: str = ".2f") -> str:
    spread = cells.spread.get(name, math.nan)
    text = finite_text(value, spec)
    return f"{text} ±{spread:{spec}}" if math.isfinite(spread) and text != "-" else text
