"""Recall tables as text, Markdown and CSV, and the list of all formats: one model behind them."""

from __future__ import annotations

import csv
import html
import io
import math
from collections.abc import Callable, Sequence

from lodbench.reporting.cells import SplitCells
from lodbench.reporting.safe_text import csv_cell, plain_text
from lodbench.reporting.table_columns import finite_text
from lodbench.reporting.table_html import format_html
from lodbench.reporting.table_latex import format_latex
from lodbench.reporting.tables import RecallTable, TableRow


def format_text(table: RecallTable) -> str:
    """Returns the table for a terminal."""
    columns = table.shown()
    head = [["", ""], ["", "method"]]
    for split in table.splits:
        count = table.denominators(split)
        head[0] += [plain_text(split) + (f" ({count} queries)" if count else ""), *[""] * (len(columns) - 1)]
        head[1] += [column.head for column in columns]
    body = [[row.group_text(), plain_text(row.label), *table.row_texts(row)] for row in _ungrouped(table)]
    if not any(row[0] for row in body):
        head, body = [row[1:] for row in head], [row[1:] for row in body]
    firsts = 2 if len(head[0]) > 1 + len(columns) * len(table.splits) else 1
    return f"{plain_text(table.title)}\n\n{_align(head, body, len(columns), firsts)}\n"


def format_markdown(table: RecallTable) -> str:
    """Returns the table in Markdown."""
    grouped = any(row.group for row in table.rows)
    names = [f"{split} {column.head}" for split in table.splits for column in table.shown()]
    first = ["Method", "Variant"] if grouped else ["Method"]
    counts = [f"{split} {table.denominators(split)}" for split in table.splits if table.denominators(split)]
    queries = f" (queries: {_md(', '.join(counts))})" if counts else ""
    lines = [f"**{_md(table.title)}**{queries}", ""]
    lines += [_pipes([*first, *names]), _pipes([*["---"] * len(first), *["--:"] * len(names)])]
    for row in _ungrouped(table):
        label = [row.group_text(), row.label] if grouped else [row.label]
        lines.append(_pipes([*label, *table.row_texts(row)]))
    return "\n".join(lines) + "\n"


def format_csv(table: RecallTable) -> str:
    """Returns the table as CSV, one line per method and split, every number in full."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    labels = table.labels()
    writer.writerow(["protocol", "group", "method", "split", *_csv_heads(labels)])
    for row in table.rows:
        for split, cells in row.cells.items():
            words = [csv_cell(text) for text in (table.title, row.group, row.label, split)]
            writer.writerow([*words, *_csv_numbers(cells, labels)])
    return stream.getvalue()


FORMATS: dict[str, Callable[[RecallTable], str]] = {
    "text": format_text,
    "markdown": format_markdown,
    "csv": format_csv,
    "latex": format_latex,
    "html": format_html,
}


def _ungrouped(table: RecallTable) -> list[TableRow]:
    """Returns the rows with each group named once, at its first row."""
    rows = []
    for number, row in enumerate(table.rows):
        repeats = number > 0 and table.rows[number - 1].group == row.group
        rows.append(row._replace(group="" if repeats else row.group))
    return rows


def _csv_heads(labels: Sequence[str]) -> list[str]:
    return [
        *labels,
        *(f"{label} {end}" for label in labels for end in ("low", "high")),
        *(f"{label} of answered" for label in labels),
        *(f"AUC {label}" for label in labels),
        "median_translation_m",
        "median_rotation_deg",
        "median_horizontal_m",
        "median_vertical_m",
        "median_yaw_deg",
        "mask_iou",
        "queries",
        "failed",
        "hypotheses_per_query",
        "seconds_per_query",
    ]


def _csv_numbers(cells: SplitCells, labels: Sequence[str]) -> list[str]:
    nan = math.nan
    more = [
        cells.more.get(name, nan) for name in ("median_horizontal_m", "median_vertical_m", "median_yaw_deg")
    ]
    return [
        *(_digits(cells.recall.get(label, nan)) for label in labels),
        *(_digits(end) for label in labels for end in cells.interval.get(label, (nan, nan))),
        *(_digits(cells.answered.get(label, nan)) for label in labels),
        *(_digits(cells.auc.get(label, nan)) for label in labels),
        *(_digits(value) for value in (cells.translation_m, cells.rotation_deg, *more)),
        _digits(cells.more.get("mask_iou", nan)),
        str(cells.num_queries),
        str(cells.num_failed),
        _digits(cells.hypotheses),
        _digits(cells.more.get("seconds_per_query", nan)),
    ]


def _digits(value: float) -> str:
    return "" if not math.isfinite(value) else finite_text(value, ".10g")


def _md(text: str) -> str:
    return html.escape(plain_text(text), quote=False).replace("|", r"\|")


def _pipes(cells: Sequence[str]) -> str:
    return "| " + " | ".join(map(_md, cells)) + " |"


def _align(head: list[list[str]], body: list[list[str]], group: int, firsts: int) -> str:
    """Returns rows in columns: ``firsts`` flush left, others right; the first head row spans ``group``."""
    widths = [max(len(row[i]) for row in [head[1], *body]) for i in range(len(head[1]))]
    for start in range(firsts, len(widths), group):
        missing = len(head[0][start]) - (sum(widths[start : start + group]) + 2 * (group - 1))
        widths[start + group - 1] += max(0, missing)

    def line(row: list[str]) -> str:
        cells = [
            cell.ljust(width) if i < firsts else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        return "  ".join(cells).rstrip()

    spans = [" " * (sum(widths[:firsts]) + 2 * (firsts - 1))]
    for start in range(firsts, len(widths), group):
        spans.append(head[0][start].center(sum(widths[start : start + group]) + 2 * (group - 1)))
    ruler = "-" * (sum(widths) + 2 * (len(widths) - 1))
    return "\n".join(["  ".join(spans).rstrip(), line(head[1]), ruler, *map(line, body)])
