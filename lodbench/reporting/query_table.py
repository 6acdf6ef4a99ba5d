"""The table of every query of a run, for its page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from lodbench.evaluation.rows import QueryRow
from lodbench.reporting.page import text

_HEADS = (
    "query", "split", "m", "deg", "along the ground m", "up m", "yaw deg", "prior m", "prior deg", "score",
    "mask IoU", "hypotheses", "failure",
)  # fmt: skip
_TEXTS = ("query", "split", "failure")


def query_table(rows: Sequence[QueryRow]) -> str:
    """Returns one line per query, sortable by every column."""
    heads = "".join(_head(head) for head in _HEADS)
    body = "\n".join(_line(row) for row in rows)
    return (
        f'<div class="scroll tall"><table class="sortable"><thead><tr>{heads}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>\n"
    )


def _head(name: str) -> str:
    side = " class=name" if name in _TEXTS else ""
    return f'<th scope="col"{side}><button type="button">{text(name)}</button></th>'


def _line(row: QueryRow) -> str:
    numbers = "".join(_cell(value, spec) for value, spec in _numbers(row))
    return (
        f'<tr><th scope="row" class="name">{text(row.name)}</th><td class="name">{text(row.split)}</td>'
        f'{numbers}<td class="name">{text(row.failure)}</td></tr>'
    )


def _numbers(row: QueryRow) -> Iterator[tuple[float | None, str]]:
    for errors in (row.error, row.parts, row.prior_error):
        count = 3 if errors is row.parts else 2
        yield from ((value, ".2f") for value in (errors or (None,) * count))
    yield row.score, ".3f"
    yield row.mask_iou, ".3f"
    yield row.hypotheses, "d"


def _cell(value: float | None, spec: str) -> str:
    if value is None or not math.isfinite(value):
        return "<td>-</td>"
    # Adding 0 turns the -0.00 of a rounded small number into 0.00.
    shown = value if spec == "d" else round(value, int(spec[1])) + 0.0
    return f'<td data-value="{value:.6g}">{shown:{spec}}</td>'
