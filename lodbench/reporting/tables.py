"""Recall tables in the paper's layout: splits side by side, from one model to every format."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodbench.errors import DatasetError


@dataclass(frozen=True, slots=True)
class SplitCells:
    """One method on one split; what is not known is NaN.

    Attributes:
        recall: Percent by threshold label.
        translation_m: Median error.
        rotation_deg: Median error.
        num_queries: Denominator.
        num_failed: Queries without an answer.
        hypotheses: Poses scored per query.
        printed: Cells to show in place of these numbers: what a paper printed; empty to format them.
    """

    recall: dict[str, float]
    translation_m: float
    rotation_deg: float
    num_queries: int
    num_failed: int
    hypotheses: float
    printed: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RecallTable:
    """Rows of methods over columns of splits.

    Attributes:
        title: What the rows have in common: dataset, tilt, segmenter, seed.
        splits: Names, left to right.
        rows: Label and cells by split.
    """

    title: str
    splits: tuple[str, ...]
    rows: tuple[tuple[str, dict[str, SplitCells]], ...]

    def labels(self) -> list[str]:
        """Returns the threshold labels of the first row that has any."""
        return next((list(cells.recall) for _, row in self.rows for cells in row.values()), [])


def read_summary(folder: Path) -> dict[str, Any]:
    """Returns the summary of a run folder.

    Raises:
        DatasetError: The folder holds no readable summary.
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
    return summary


def tables_of(summaries: Sequence[dict[str, Any]]) -> list[RecallTable]:
    """Returns one table per protocol (dataset, tilt, segmenter, seed), the priors' row on top of each.

    Runs over other queries, masks or another city never share a table, whatever their names.
    """
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for summary in summaries:
        inputs = [str(summary["dataset"].get(name, "")) for name in ("queries", "scene", "masks")]
        renderer = str(summary["protocol"].get("renderer", ""))
        groups.setdefault((title_of(summary), renderer, *inputs), []).append(summary)
    return [_table(title, members) for (title, *_), members in groups.items()]


def title_of(summary: dict[str, Any]) -> str:
    """Returns what a run's table is headed with: everything that must agree to compare rows."""
    dataset, protocol = summary["dataset"], summary["protocol"]
    version = f" ({dataset['version']})" if dataset.get("version") else ""
    lod = f" · LoD{protocol['lod']}" if protocol.get("lod") else ""
    drawn = protocol.get("prior", "dataset")
    prior = "" if drawn == "dataset" else f" · priors {drawn}"
    return (
        f"{dataset['name']}{version}{lod} · tilt={protocol['tilt']} · segmenter={protocol['segmenter']}"
        f" · seed={protocol['seed']}{prior}"
    )


def _table(title: str, members: list[dict[str, Any]]) -> RecallTable:
    splits = tuple(dict.fromkeys(split for member in members for split in member["splits"]))
    rows = [("Prior", {split: cells_of(value) for split, value in members[0]["prior"].items()})]
    for member in members:
        method = member["method"]
        label = " ".join(filter(None, [method["name"], method.get("variant", "").replace("_", " ")]))
        rows.append((label, {split: cells_of(value) for split, value in member["splits"].items()}))
    return RecallTable(title, splits, tuple(rows))


def cells_of(summary: dict[str, Any]) -> SplitCells:
    """Returns the cells of one split of a ``summary.json``."""

    def number(name: str) -> float:
        value = summary.get(name)
        return math.nan if value is None else float(value)

    return SplitCells(
        summary["recall"],
        number("median_translation_m"),
        number("median_rotation_deg"),
        summary["num_queries"],
        summary["num_failed"],
        number("hypotheses_per_query"),
    )


def format_text(table: RecallTable) -> str:
    """Returns the table for a terminal."""
    labels = table.labels()
    head = [[""], ["method"]]
    for split in table.splits:
        count = next((row[split].num_queries for _, row in table.rows if split in row), 0)
        head[0] += [f"{split} ({count} queries)", *[""] * (len(labels) + 1)]
        head[1] += [*labels, "T.e./R.e.", "failed"]
    body = [[label, *_row_cells(table, row, labels)] for label, row in table.rows]
    return f"{table.title}\n\n{_align(head, body, len(labels) + 2)}\n"


def format_markdown(table: RecallTable) -> str:
    """Returns the table in Markdown."""
    labels = table.labels()
    header = [
        "Method",
        *(f"{split} {name}" for split in table.splits for name in [*labels, "T.e./R.e.", "failed"]),
    ]
    lines = [f"**{table.title}**", "", _pipes(header), _pipes(["---"] + ["--:"] * (len(header) - 1))]
    lines += [_pipes([label, *_row_cells(table, row, labels)]) for label, row in table.rows]
    return "\n".join(lines) + "\n"


def format_csv(table: RecallTable) -> str:
    """Returns the table as CSV, one line per method and split."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    labels = table.labels()
    writer.writerow(
        [
            "protocol",
            "method",
            "split",
            *labels,
            "median_translation_m",
            "median_rotation_deg",
            "queries",
            "failed",
        ]
    )
    for label, row in table.rows:
        for split, cells in row.items():
            recall = [f"{cells.recall[name]:.2f}" for name in labels]
            medians = [_finite(cells.translation_m, ".4f"), _finite(cells.rotation_deg, ".4f")]
            writer.writerow(
                [table.title, label, split, *recall, *medians, cells.num_queries, cells.num_failed]
            )
    return stream.getvalue()


def format_latex(table: RecallTable) -> str:
    """Returns the table as a LaTeX tabular in the paper's layout (needs booktabs)."""
    labels = table.labels()
    width = len(labels) + 1
    spans = " & ".join(rf"\multicolumn{{{width}}}{{c}}{{\textit{{{_tex(split)}}}}}" for split in table.splits)
    names = " & ".join(
        [*(label.replace("deg", r"$^\circ$") for label in labels), "T.e./R.e."] * len(table.splits)
    )
    lines = [rf"% {table.title}", rf"\begin{{tabular}}{{l{'c' * (width * len(table.splits))}}}", r"\toprule"]
    lines += [rf"Method & {spans} \\", rf" & {names} \\", r"\midrule"]
    for label, row in table.rows:
        cells = [
            cell
            for split in table.splits
            for cell in (_split_cells(row.get(split), labels)[:-1] if split in row else ["-"] * width)
        ]
        lines.append(rf"{_tex(label)} & {' & '.join(cells)} \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


FORMATS: dict[str, Callable[[RecallTable], str]] = {
    "text": format_text,
    "markdown": format_markdown,
    "csv": format_csv,
    "latex": format_latex,
}


def _row_cells(table: RecallTable, row: dict[str, SplitCells], labels: list[str]) -> list[str]:
    return [cell for split in table.splits for cell in _split_cells(row.get(split), labels)]


def _split_cells(cells: SplitCells | None, labels: list[str]) -> list[str]:
    if cells is None:
        return ["-"] * (len(labels) + 2)
    if cells.printed:
        return list(cells.printed)
    medians = f"{_finite(cells.translation_m, '.2f')}/{_finite(cells.rotation_deg, '.2f')}"
    return [*(_finite(cells.recall[name], ".2f") for name in labels), medians, str(cells.num_failed)]


def _finite(value: float, spec: str) -> str:
    return format(value, spec) if math.isfinite(value) else "-"


def _pipes(cells: Sequence[str]) -> str:
    escaped = (cell.replace("|", r"\|").replace("<", "&lt;") for cell in cells)
    return "| " + " | ".join(escaped) + " |"


def _tex(text: str) -> str:
    return re.sub(r"[&%$#_{}]", r"\\\g<0>", text.replace("\\", "/").replace("~", "-").replace("^", ""))


def _align(head: list[list[str]], body: list[list[str]], group: int) -> str:
    """Returns rows in columns: first left, others right; the first head row spans ``group`` columns."""
    widths = [max(len(row[i]) for row in [head[1], *body]) for i in range(len(head[1]))]
    for start in range(1, len(widths), group):
        missing = len(head[0][start]) - (sum(widths[start : start + group]) + 2 * (group - 1))
        widths[start + group - 1] += max(0, missing)

    def line(row: list[str]) -> str:
        cells = [
            row[0].ljust(widths[0]),
            *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)),
        ]
        return "  ".join(cells).rstrip()

    spans = [" " * widths[0]]
    for start in range(1, len(widths), group):
        spans.append(head[0][start].center(sum(widths[start : start + group]) + 2 * (group - 1)))
    ruler = "-" * (sum(widths) + 2 * (len(widths) - 1))
    return "\n".join(["  ".join(spans).rstrip(), line(head[1]), ruler, *map(line, body)])
