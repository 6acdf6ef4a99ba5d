"""The model of a recall table: methods by splits, from summaries of runs; formats are elsewhere."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from lodbench.citymodel.lods import lod_in_words
from lodbench.reporting.cells import SplitCells, cells_of, mean_cells
from lodbench.reporting.safe_text import plain_text
from lodbench.reporting.table_columns import Column, paper_columns


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

    def group_text(self) -> str:
        """Returns ``name (map)`` of a group ``name | map``."""
        name, _, map_name = plain_text(self.group).partition(" | ")
        return f"{name} ({map_name})" if map_name else name


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

    def says_how_sure(self) -> bool:
        """Tells whether any method gave a probability."""
        every = [cells for row in self.rows for cells in row.cells.values()]
        return any(math.isfinite(cells.more.get("said", math.nan)) for cells in every)

    def row_texts(self, row: TableRow) -> list[str]:
        """Returns the cells of a row, all columns of the first split first."""
        return [column.shown(row.cells.get(split)) for split in self.splits for column in self.shown()]

    def denominators(self, split: str) -> str:
        """Returns the numbers of queries of a split: one, or all there are; "" where none is known."""
        counts = dict.fromkeys(row.cells[split].num_queries for row in self.rows if split in row.cells)
        return "/".join(str(count) for count in counts if count)


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
    lod = f" · {lod_in_words(str(protocol['lod']))}" if protocol.get("lod") and "lod" not in free else ""
    words = [f"{name}={protocol[name]}" for name in ("tilt", "segmenter", "seed") if name not in free]
    drawn = protocol.get("prior", "file")
    if drawn != "file" and "prior" not in free:
        words.append(f"priors {drawn}")
    return " · ".join([f"{dataset['name']}{version}{lod}", *words])


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
        found.append(TableRow(shown, {name: mean_cells(runs, name) for name in runs[0]["splits"]}))
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
