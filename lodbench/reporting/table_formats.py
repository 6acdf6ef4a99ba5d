"""Recall tables as text, Markdown, CSV, LaTeX and HTML, all from the one model."""

from __future__ import annotations

import csv
import html
import io
import math
import re
from collections.abc import Callable, Sequence

from lodbench.reporting.safe_text import csv_cell, plain_text
from lodbench.reporting.tables import Column, RecallTable, SplitCells, TableRow, finite_text


def format_text(table: RecallTable) -> str:
    """Returns the table for a terminal."""
    columns = table.shown()
    head = [["", ""], ["", "method"]]
    for split in table.splits:
        count = _queries(table, split)
        head[0] += [plain_text(split) + (f" ({count} queries)" if count else ""), *[""] * (len(columns) - 1)]
        head[1] += [column.head for column in columns]
    body = [[_group_text(row), plain_text(row.label), *_row_cells(table, row)] for row in _ungrouped(table)]
    if not any(row[0] for row in body):
        head, body = [row[1:] for row in head], [row[1:] for row in body]
    firsts = 2 if len(head[0]) > 1 + len(columns) * len(table.splits) else 1
    return f"{plain_text(table.title)}\n\n{_align(head, body, len(columns), firsts)}\n"


def format_markdown(table: RecallTable) -> str:
    """Returns the table in Markdown."""
    grouped = any(row.group for row in table.rows)
    names = [f"{split} {column.head}" for split in table.splits for column in table.shown()]
    first = ["Method", "Variant"] if grouped else ["Method"]
    counts = [f"{split} {_queries(table, split)}" for split in table.splits if _queries(table, split)]
    queries = f" (queries: {_md(', '.join(counts))})" if counts else ""
    lines = [f"**{_md(table.title)}**{queries}", ""]
    lines += [_pipes([*first, *names]), _pipes([*["---"] * len(first), *["--:"] * len(names)])]
    for row in _ungrouped(table):
        label = [_group_text(row), row.label] if grouped else [row.label]
        lines.append(_pipes([*label, *_row_cells(table, row)]))
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
            _tex_cell(_text(column, row.cells.get(split)), (number, column.head) in best[split])
            for split in table.splits
            for column in columns
        ]
        line = " & ".join([*first, *cells])
        # The end of the row above would take these for its own.
        lines.append(rf"{'{}' if line.startswith(('[', '*')) else ''}{line} \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def format_html(table: RecallTable) -> str:
    """Returns the table as an HTML table whose columns a script may sort by ``data-value``."""
    columns = table.shown()
    width = len(columns)
    spans = "".join(
        f'<th colspan="{width}" scope="colgroup" class="split">{html.escape(plain_text(split))}'
        f"{_html_count(table, split)}</th>"
        for split in table.splits
    )
    heads = "".join(
        f'<th scope="col"{" class=first" if i == 0 else ""}>{_button(column.head)}</th>'
        for _ in table.splits
        for i, column in enumerate(columns)
    )
    body = "\n".join(_html_row(table, row) for row in table.rows)
    return (
        f'<figure class="table"><figcaption>{html.escape(plain_text(table.title))}</figcaption>\n'
        f'<div class="scroll"><table class="sortable"><thead><tr><th class="name"></th>{spans}</tr>\n'
        f'<tr><th scope="col" class="name">{_button("method")}</th>{heads}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div></figure>\n"
    )


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


def _html_count(table: RecallTable, split: str) -> str:
    count = _queries(table, split)
    return f" <small>{count} queries</small>" if count else ""


def _button(text: str) -> str:
    return f'<button type="button">{html.escape(text)}</button>'


def _html_row(table: RecallTable, row: TableRow) -> str:
    name = html.escape(plain_text(row.label))
    if row.group:
        name = f"<small>{html.escape(_group_text(row))}</small> {name}"
    cells = []
    for split in table.splits:
        for i, column in enumerate(table.shown()):
            known = row.cells.get(split)
            value = math.nan if known is None else column.value(known)
            key = f' data-value="{value!r}"' if math.isfinite(value) else ""
            edge = " class=first" if i == 0 else ""
            cells.append(f"<td{edge}{key}>{html.escape(_text(column, known))}</td>")
    return f'<tr><th scope="row" class="name">{name}</th>{"".join(cells)}</tr>'


def _row_cells(table: RecallTable, row: TableRow) -> list[str]:
    return [_text(column, row.cells.get(split)) for split in table.splits for column in table.shown()]


def _text(column: Column, cells: SplitCells | None) -> str:
    if cells is None:
        return "-"
    if cells.printed:
        return plain_text(cells.printed.get(column.head, "-"))
    return column.text(cells)


def _ungrouped(table: RecallTable) -> list[TableRow]:
    """Returns the rows with each group named once, at its first row."""
    rows = []
    for number, row in enumerate(table.rows):
        repeats = number > 0 and table.rows[number - 1].group == row.group
        rows.append(row._replace(group="" if repeats else row.group))
    return rows


def _group_text(row: TableRow) -> str:
    """Returns ``name (map)`` of a group ``name | map``."""
    name, _, map_name = plain_text(row.group).partition(" | ")
    return f"{name} ({map_name})" if map_name else name


def _queries(table: RecallTable, split: str) -> str:
    """Returns the denominators of a split: one number, or all there are; "" where none is known."""
    counts = dict.fromkeys(row.cells[split].num_queries for row in table.rows if split in row.cells)
    return "/".join(str(count) for count in counts if count)


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
