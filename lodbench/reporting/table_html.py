"""Recall tables as HTML that a script may sort."""

from __future__ import annotations

import html
import math

from lodbench.reporting.safe_text import plain_text
from lodbench.reporting.tables import RecallTable, TableRow


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


def _html_count(table: RecallTable, split: str) -> str:
    count = table.denominators(split)
    return f" <small>{count} queries</small>" if count else ""


def _button(text: str) -> str:
    return f'<button type="button">{html.escape(text)}</button>'


def _html_row(table: RecallTable, row: TableRow) -> str:
    name = html.escape(plain_text(row.label))
    if row.group:
        name = f"<small>{html.escape(row.group_text())}</small> {name}"
    cells = []
    for split in table.splits:
        for i, column in enumerate(table.shown()):
            known = row.cells.get(split)
            value = math.nan if known is None else column.value(known)
            key = f' data-value="{value!r}"' if math.isfinite(value) else ""
            edge = " class=first" if i == 0 else ""
            cells.append(f"<td{edge}{key}>{html.escape(column.shown(known))}</td>")
    return f'<tr><th scope="row" class="name">{name}</th>{"".join(cells)}</tr>'
