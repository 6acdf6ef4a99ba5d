"""Paired comparisons as text, and curves of several methods over the same queries."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.evaluation.errors import Apart
from lodbench.evaluation.statistics import Agreement, Comparison
from lodbench.reporting.aligned_text import count_of, format_columns, plain_text
from lodbench.reporting.figures import LINE_STYLES, SERIES, draw_figure
from lodbench.reporting.run_figures import PRIOR, shares_below
from lodbench.reporting.table_columns import finite_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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


_FURTHEST_M, _FURTHEST_DEG, _LARGEST = 100.0, 180.0, 10.0

# Of runs in turn: the first two are those of A and B on maps and photos. Orange is the prior
# everywhere.
_OF_RUNS = (SERIES[0], SERIES[4], SERIES[2], SERIES[3], SERIES[5])


class ErrorCurve(NamedTuple):
    """Errors of one method: (N, 2) metres and degrees, failures being (inf, 180)."""

    name: str
    errors: NDArray[np.float64]


def draw_comparison(curves: Sequence[ErrorCurve]) -> dict[str, bytes]:
    """Returns recall at (t m, t deg) over t, and the shares of queries below each error."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots(1, 3, sharey=True)
        for number, curve in enumerate(curves):
            is_prior = curve.name == "prior"
            style: dict[str, Any] = {
                "color": PRIOR if is_prior else _OF_RUNS[number % len(_OF_RUNS)],
                "linestyle": ":" if is_prior else LINE_STYLES[number // len(_OF_RUNS) % len(LINE_STYLES)],
                "label": curve.name,
            }
            # Below both limits: the larger of the two errors is.
            _draw(axes[0], curve.errors.max(axis=1), len(curve.errors), _LARGEST, style)
            answered = np.isfinite(curve.errors[:, 0])
            _draw(axes[1], curve.errors[answered, 0], len(curve.errors), _FURTHEST_M, style)
            _draw(axes[2], curve.errors[answered, 1], len(curve.errors), _FURTHEST_DEG, style)
        axes[0].set(
            xlim=(0, _LARGEST), ylim=(0, 101), xlabel="threshold t: t m and t deg", ylabel="queries, %"
        )
        for axis, furthest, unit in ((axes[1], _FURTHEST_M, "m"), (axes[2], _FURTHEST_DEG, "deg")):
            axis.set_xscale("log")
            axis.xaxis.set_major_formatter("{x:g}")
            axis.set(xlim=(0.01, furthest), xlabel=f"error below, {unit}")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)

    return draw_figure(11.0, 3.6, draw)


def _draw(
    axis: Axes, errors: NDArray[np.float64], count: int, furthest: float, style: dict[str, Any]
) -> None:
    x, shares = shares_below(errors, count, furthest)
    axis.step(x, shares, where="post", **style)
