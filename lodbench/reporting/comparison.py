"""Paired comparisons as text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from lodbench.evaluation.errors import Apart
from lodbench.evaluation.statistics import Agreement, Comparison
from lodbench.reporting.aligned_text import count_of, format_columns
from lodbench.reporting.safe_text import plain_text
from lodbench.reporting.table_columns import finite_text

# Of differences on a terminal; a page has all of them.
_MOST_LINES = 20
PAIRED_NOTE = (
    "Paired by query. Recall: exact McNemar test, interval of Bonett and Price. Medians: permutation "
    "test (1,999 swaps), bootstrap over queries. No correction for the number of tests."
)


def format_comparison(rows: Iterable[Comparison], names: tuple[str, str]) -> str:
    """Returns the tests of two runs as a table with a line that says what they are."""
    return f"{format_columns(comparison_cells(rows, names))}\n\n{PAIRED_NOTE}"


def comparison_cells(rows: Iterable[Comparison], names: tuple[str, str]) -> list[list[str]]:
    """Returns the tests of two runs as cells, the head first, with the names of both."""
    body = [["", *names, "difference", "95 % interval", "p"]]
    for row in rows:
        low, high = row.test.interval
        bounds = f"[{low:+.2f}, {high:+.2f}]" if math.isfinite(low) and math.isfinite(high) else "-"
        values = [finite_text(value, ".2f") for value in (row.first, row.second)]
        difference = finite_text(row.test.difference, "+.2f")
        body.append([f"{row.split} {row.name} {row.unit}", *values, difference, bounds, _p_text(row.test.p)])
    return body


def agreement_text(found: Agreement | None) -> str:
    """Returns in words how far the answers of two runs lie apart; "" where no query has two."""
    if found is None:
        return ""
    return (
        f"Both runs answered {count_of(found.answered, 'queries')}; {found.within} within 2 m and 2 deg of "
        f"each other; median difference {found.median_m:.2f} m ({found.median_plan_m:.2f} m in plan, "
        f"{found.median_height_m:.2f} m in height) and {found.median_deg:.2f} deg."
    )


def format_apart(found: Mapping[str, Apart]) -> str:
    """Returns how far answers to the same photos lie apart, a line each, those furthest apart first.

    Args:
        found: By the key of the photo.
    """
    ranked = sorted(found.items(), key=lambda item: (-item[1].error.translation_m, item[0]))
    rows = [["", "apart m", "apart deg", "in plan m", "in height m"]]
    for key, ((metres, degrees), parts) in ranked[:_MOST_LINES]:
        numbers = [f"{metres:.2f}", f"{degrees:.2f}", f"{parts.horizontal_m:.2f}", f"{parts.vertical_m:+.2f}"]
        rows.append([plain_text(key), *numbers])
    left = len(found) - _MOST_LINES
    more = f"\n{count_of(left, 'more photos')}: --out compared.html shows all" if left > 0 else ""
    return f"{format_columns(rows)}{more}"


def _p_text(p: float) -> str:
    if not math.isfinite(p):
        return "-"
    return "< 0.001" if p < 0.001 else f"{p:.3f}"
