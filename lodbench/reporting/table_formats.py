"""Recall tables as text, Markdown, CSV, LaTeX and HTML: one model behind them."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Callable, Sequence

import numpy as np

from lodbench.reporting.aligned_text import count_of, csv_cell, plain_text
from lodbench.reporting.page import rendered
from lodbench.reporting.table_columns import Column
from lodbench.reporting.tables import Line, RecallTable, frame_of


def format_text(table: RecallTable) -> str:
    """Returns the table for a terminal."""
    width = len(table.shown())
    head = [["", ""], ["", "method"]]
    for split in table.splits:
        count = table.denominators(split)
        head[0] += [
            plain_text(split) + (f" ({count_of(count, 'queries')})" if count else ""),
            *[""] * (width - 1),
        ]
        head[1] += [column.head for column in table.shown()]
    body = [[group, plain_text(line.label), *table.texts(line)] for group, line in _grouped(table)]
    if not any(row[0] for row in body):
        head, body = [row[1:] for row in head], [row[1:] for row in body]
    firsts = 2 if len(head[0]) > 1 + width * len(table.splits) else 1
    return f"{plain_text(table.title)}\n\n{_align(head, body, width, firsts)}\n"


def format_markdown(table: RecallTable) -> str:
    """Returns the table in Markdown."""
    is_grouped = any(line.group for line in table.lines)
    names = [f"{split} {column.head}" for split in table.splits for column in table.shown()]
    first = ["Method", "Variant"] if is_grouped else ["Method"]
    counts = [f"{split} {table.denominators(split)}" for split in table.splits if table.denominators(split)]
    queries = f" (queries: {_md(', '.join(counts))})" if counts else ""
    lines = [f"**{_md(table.title)}**{queries}", ""]
    lines += [_pipes([*first, *names]), _pipes([*["---"] * len(first), *["--:"] * len(names)])]
    for group, line in _grouped(table):
        lines.append(_pipes([*([group] if is_grouped else []), line.label, *table.texts(line)]))
    return "\n".join(lines) + "\n"


def format_csv(*tables: RecallTable) -> str:
    """Returns tables as one CSV, a line per method and split, every number to ten digits, under one head."""
    frame = frame_of(tables)
    frame.insert(0, "protocol", frame.pop("protocol"))
    words = ["protocol", "group", "method", "split"]
    frame[words] = frame[words].map(csv_cell)
    frame = frame.replace([math.inf, -math.inf], math.nan)
    return str(frame.to_csv(index=False, float_format="%.10g", lineterminator="\n"))


def format_latex(table: RecallTable) -> str:
    """Returns the table as a LaTeX tabular in the paper's layout (needs booktabs, multirow, makecell)."""
    columns = tuple(column for column in table.shown() if column.head != "failed")
    shown = RecallTable(table.title, table.lines, columns)
    is_grouped = any(line.group for line in table.lines)
    firsts, width = (2 if is_grouped else 1), len(columns)
    best = _best(shown)
    rows = []
    for number, (line, follows) in enumerate(zip(table.lines, (None, *table.lines), strict=False)):
        starts = follows is None or follows.group != line.group or not line.group
        cells = [
            rf"\textbf{{{tex(text)}}}" if (number, i) in best and text != "-" else tex(text)
            for i, text in enumerate(shown.texts(line))
        ]
        first = (
            [_tex_group(table, number) if starts else "", tex(line.label)]
            if is_grouped
            else [tex(line.label)]
        )
        if is_grouped and not line.group:
            first = [rf"\multicolumn{{2}}{{l}}{{{tex(line.label)}}}"]
        text = " & ".join([*first, *cells])
        # The end of the row above would take these for its own.
        text = "{}" + text if text.startswith(("[", "*")) else text
        rows.append((text, bool(number) and is_grouped and starts))
    return rendered(
        "table.tex.jinja",
        title=plain_text(table.title),
        layout="l" * firsts + "c" * (width * len(table.splits)),
        spans=[rf"\multicolumn{{{width}}}{{c}}{{\textit{{{tex(split)}}}}}" for split in table.splits],
        ends=[(firsts + 1 + i * width, firsts + (i + 1) * width) for i in range(len(table.splits))],
        heads=[tex(column.head).replace("deg", r"$^\circ$") for column in columns] * len(table.splits),
        blank="& " * (firsts - 1),
        rows=rows,
    )


def format_html(table: RecallTable) -> str:
    """Returns the table as an HTML table whose columns a script may sort by ``data-value``."""
    return rendered("table.html.jinja", table=table, isfinite=math.isfinite)


FORMATS: dict[str, Callable[[RecallTable], str]] = {
    "text": format_text,
    "markdown": format_markdown,
    "csv": format_csv,
    "latex": format_latex,
    "html": format_html,
}


def tex(text: str) -> str:
    """Returns plain text with every character that LaTeX gives a meaning made harmless."""
    plain = plain_text(text).replace("\\", "/").replace("~", "-").replace("^", "")
    return re.sub(r"[&%$#_{}]", r"\\\g<0>", plain).replace("±", r"$\pm$").replace("·", r"$\cdot$")


def _best(table: RecallTable) -> set[tuple[int, int]]:
    """Returns the line and place of the best cells of each column, where there is anything to compare.

    The prior is no method; a recall of 0 is nobody's best; a cell of two numbers is best if both are.
    """
    places = [(n, list(table.cells(line))) for n, line in enumerate(table.lines) if not line.is_prior]
    found: set[tuple[int, int]] = set()
    for i in range(len(places[0][1]) if places else 0):
        column: Column = places[0][1][i][0]
        rows = {n: cells[i][1] for n, cells in places}
        values = {n: np.multiply(column.better, column.values(row)) for n, row in rows.items() if row}
        known = {n: value for n, value in values.items() if np.isfinite(value).all()}
        if column.better and len(known) > 1:
            most = np.max(list(known.values()), axis=0)
            is_any = column.better < 0 or most[0] > 0
            found |= {(n, i) for n, value in known.items() if is_any and np.array_equal(value, most)}
    return found


def _tex_group(table: RecallTable, start: int) -> str:
    """Returns the cell that names a group and spans its lines; ``name | map`` on two lines."""
    group, count = table.lines[start].group, 0
    while start + count < len(table.lines) and table.lines[start + count].group == group:
        count += 1
    name, _, map_name = group.partition(" | ")
    cell = rf"\makecell[c]{{{tex(name)}\\\textit{{{tex(map_name)}}}}}" if map_name else tex(name)
    return rf"\multirow{{{count}}}{{*}}{{{cell}}}" if count > 1 else cell


def _grouped(table: RecallTable) -> list[tuple[str, Line]]:
    """Returns the lines with each group named once, at its first line."""
    befores = (None, *table.lines)
    return [
        ("" if before is not None and before.group == line.group else line.group_text(), line)
        for before, line in zip(befores, table.lines, strict=False)
    ]


def _md(text: str) -> str:
    return html.escape(plain_text(text), quote=False).replace("|", r"\|")


def _pipes(cells: Sequence[str]) -> str:
    return "| " + " | ".join(map(_md, cells)) + " |"


def _align(head: list[list[str]], body: list[list[str]], group: int, firsts: int) -> str:
    """Returns rows in columns: ``firsts`` flush left, others right; the first head row spans ``group``."""
    widths = [max(map(len, column)) for column in zip(head[1], *body, strict=True)]
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
