"""Recall tables in LaTeX, in the paper's layout."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from lodbench.reporting.safe_text import plain_text
from lodbench.reporting.table_columns import Column
from lodbench.reporting.tables import RecallTable


def format_latex(table: RecallTable) -> str:
    """Returns the table as a LaTeX tabular in the paper's layout (needs booktabs, multirow, makecell)."""
    columns = [column for column in table.shown() if column.head != "failed"]
    grouped = any(row.group for row in table.rows)
    firsts, width = 2 if grouped else 1, len(columns)
    spans = " & ".join(rf"\multicolumn{{{width}}}{{c}}{{\textit{{{tex(split)}}}}}" for split in table.splits)
    ends = [(firsts + 1 + i * width, firsts + (i + 1) * width) for i in range(len(table.splits))]
    rules = " ".join(rf"\cmidrule(r){{{first}-{last}}}" for first, last in ends)
    heads = [tex(column.head).replace("deg", r"$^\circ$") for column in columns] * len(table.splits)
    blank = "& " * (firsts - 1)
    lines = [
        f"% {plain_text(table.title)}",
        rf"\begin{{tabular}}{{{'l' * firsts}{'c' * (width * len(table.splits))}}}",
        r"\toprule",
        rf"Method {blank}& {spans} \\ {rules}",
        rf"{blank}& {' & '.join(heads)} \\",
        r"\midrule",
    ]
    best = {split: _best(table, split, columns) for split in table.splits}
    for number, row in enumerate(table.rows):
        starts = number == 0 or table.rows[number - 1].group != row.group or not row.group
        if number and grouped and starts:
            lines.append(r"\midrule")
        first = [_tex_group(table, number) if starts else "", tex(row.label)] if grouped else [tex(row.label)]
        if grouped and not row.group:
            first = [rf"\multicolumn{{2}}{{l}}{{{tex(row.label)}}}"]
        cells = [
            _tex_cell(column.shown(row.cells.get(split)), (number, column.head) in best[split])
            for split in table.splits
            for column in columns
        ]
        line = " & ".join([*first, *cells])
        # The end of the row above would take these for its own.
        lines.append(rf"{'{}' if line.startswith(('[', '*')) else ''}{line} \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def tex(text: str) -> str:
    """Returns plain text with every character that LaTeX gives a meaning made harmless."""
    plain = plain_text(text).replace("\\", "/").replace("~", "-").replace("^", "")
    return re.sub(r"[&%$#_{}]", r"\\\g<0>", plain).replace("±", r"$\pm$").replace("·", r"$\cdot$")


def _best(table: RecallTable, split: str, columns: Sequence[Column]) -> set[tuple[int, str]]:
    """Returns the row and column of the best numbers of a split, where there is anything to compare."""
    found: set[tuple[int, str]] = set()
    for column in columns:
        values = {
            number: column.better * column.value(row.cells[split])
            for number, row in enumerate(table.rows)
            if split in row.cells and math.isfinite(column.value(row.cells[split]))
        }
        if column.better and len(values) > 1:
            most = max(values.values())
            found |= {(number, column.head) for number, value in values.items() if value == most}
    return found


def _tex_cell(text: str, is_best: bool) -> str:
    cell = tex(text)
    return rf"\textbf{{{cell}}}" if is_best and cell != "-" else cell


def _tex_group(table: RecallTable, start: int) -> str:
    """Returns the cell that names a group and spans its rows; ``name | map`` on two lines."""
    group = table.rows[start].group
    count = 0
    while start + count < len(table.rows) and table.rows[start + count].group == group:
        count += 1
    name, _, map_name = group.partition(" | ")
    cell = rf"\makecell[c]{{{tex(name)}\\\textit{{{tex(map_name)}}}}}" if map_name else tex(name)
    return rf"\multirow{{{count}}}{{*}}{{{cell}}}" if count > 1 else cell
