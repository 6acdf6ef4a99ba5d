"""Figures of runs: how errors spread, how scores rose, methods beside each other; paired tests as text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.evaluation.pose_errors import Apart
from lodbench.evaluation.statistics import Agreement, Comparison
from lodbench.reporting.aligned_text import count_of, format_columns, plain_text
from lodbench.reporting.figures import LINE_STYLES, SERIES, draw_figure
from lodbench.reporting.table_heads import finite_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


Floats = NDArray[np.float64]
PRIOR, ESTIMATE, _INK = SERIES[1], SERIES[0], "#222222"
# Where a camera error stops mattering: beyond this it is just lost.
_FURTHEST_M, _FURTHEST_DEG = 100.0, 180.0
# Evidence is drawn evenly as far as this, and by its logarithm from there on.
_LINEAR_NATS = 10.0


class ErrorSample(NamedTuple):
    """Errors of one split: (N, 2) metres and degrees, failures being (inf, 180)."""

    split: str
    estimates: Floats
    priors: Floats


class Trace(NamedTuple):
    """Best score after each step, by stage, of one query."""

    name: str
    stages: dict[str, tuple[float, ...]]


def draw_error_curves(samples: Sequence[ErrorSample]) -> dict[str, bytes]:
    """Returns the share of queries below each error, in metres and in degrees, prior and estimate."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots(1, 2, sharey=True)
        for axis, column, unit, furthest in zip(
            axes, (0, 1), ("m", "deg"), (_FURTHEST_M, _FURTHEST_DEG), strict=True
        ):
            for style, sample in zip(cycle(LINE_STYLES), samples, strict=False):
                for what, errors, colour in (
                    ("estimate", sample.estimates, ESTIMATE),
                    ("prior", sample.priors, PRIOR),
                ):
                    # A failed query's angle is finite, but no answer's: its place is nowhere.
                    answered = errors[np.isfinite(errors[:, 0]), column]
                    shares = shares_below(answered, len(errors), furthest)
                    name = f"{what}, {sample.split}"
                    axis.step(*shares, where="post", color=colour, linestyle=style, label=name)
            axis.set_xscale("log")
            axis.xaxis.set_major_formatter("{x:g}")
            axis.set(xlim=(0.01, furthest), ylim=(0, 101), xlabel=f"error below, {unit}")
        axes[0].set_ylabel("queries, %")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)

    return draw_figure(8.6, 3.4, draw)


def shares_below(errors: Floats, count: int, furthest: float) -> tuple[Floats, Floats]:
    """Returns where the share of ``count`` queries below an error rises, and to what percent.

    Args:
        errors: (N,) errors of the answered queries.
        count: All queries.
        furthest: Where the curve ends.
    """
    ordered = np.sort(errors[errors < furthest])
    shares = 100.0 * np.arange(len(ordered) + 1) / max(1, count)
    # A logarithmic axis has no 0: the curve begins left of what is shown.
    return np.concatenate([[1e-4], np.maximum(ordered, 1e-3), [furthest]]), np.append(shares, shares[-1])


# Of traces that are no beam's, in turn.
_DASHES = (":", "-.", "--")


def draw_traces(traces: Sequence[Trace]) -> dict[str, bytes]:
    """Returns the best score after each step of each query, all beams and the best of them."""
    columns = min(3, len(traces))
    rows = -(-len(traces) // columns)

    def draw(figure: Figure) -> None:
        axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
        for axis, trace in zip(axes, traces, strict=False):
            stages = {name: scores for name, scores in trace.stages.items() if len(scores) > 1}
            beams = sum("beam" in name for name in stages)
            for number, (name, scores) in enumerate(
                sorted(stages.items(), key=lambda item: "beam" not in item[0])
            ):
                is_beam = "beam" in name
                colour = SERIES[number % len(SERIES)] if is_beam else _INK
                dashes = _DASHES[(number - beams) % len(_DASHES)]
                style = {"linewidth": 1.2} if is_beam else {"linewidth": 0.8, "linestyle": dashes}
                axis.plot(range(1, len(scores) + 1), scores, color=colour, label=name, **style)
            axis.set_title(trace.name, fontsize=8)
        for axis in axes[len(traces) :]:
            axis.set_visible(False)
        handles = axes[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside upper center", ncols=4)
        figure.supxlabel("step", fontsize=9)
        figure.supylabel("score", fontsize=9)

    return draw_figure(2.9 * columns + 0.3, 2.0 * rows + 0.4, draw)


def round_ticks(furthest: float) -> list[float]:
    """Returns 0 and round numbers up to a number: evenly up to 10, from there on ten times the last.

    Example:
        >>> round_ticks(2.86), round_ticks(8.4), round_ticks(7900.0)
        ([0.0, 1.0, 2.0], [0.0, 2.0, 4.0, 6.0, 8.0], [0.0, 5.0, 10.0, 100.0, 1000.0])
    """
    if furthest > _LINEAR_NATS:
        decades = math.floor(math.log10(furthest))
        return [0.0, _LINEAR_NATS / 2, *(10.0**k for k in range(1, decades + 1))]
    power = 10.0 ** math.floor(math.log10(furthest))
    step = next(each * power for each in (0.2, 0.5, 1.0, 2.0) if furthest <= 5 * each * power)
    return [k * step for k in range(int(furthest / step + 1e-9) + 1)]


def draw_evidence(traces: Sequence[Trace]) -> dict[str, bytes]:
    """Returns by how many nats the answers found to each query are behind the best, best first."""
    columns = min(3, len(traces))
    rows = -(-len(traces) // columns)
    furthest = max(max(values) for trace in traces for values in trace.stages.values()) or 1.0
    ticks = round_ticks(furthest)

    def draw(figure: Figure) -> None:
        axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
        for axis, trace in zip(axes, traces, strict=False):
            for number, values in enumerate(trace.stages.values()):
                axis.plot(range(1, len(values) + 1), values, ".", color=SERIES[number % len(SERIES)])
            axis.set_yscale("symlog", linthresh=_LINEAR_NATS)
            axis.set_yticks(ticks)
            axis.set_yticks([], minor=True)
            axis.yaxis.set_major_formatter("{x:g}")
            axis.xaxis.get_major_locator().set_params(integer=True)
            axis.set_title(trace.name, fontsize=8)
        # Of axes that all share; the best is at the top.
        axes[0].set_ylim(1.1 * furthest, -0.06 * min(furthest, _LINEAR_NATS))
        for axis in axes[len(traces) :]:
            axis.set_visible(False)
        figure.supxlabel("answer", fontsize=9)
        figure.supylabel("nats behind the best", fontsize=9)

    return draw_figure(2.9 * columns + 0.3, 2.0 * rows + 0.4, draw)


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
    """Returns how far answers to the same photos lie apart, a line each, those furthest apart first."""
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


_LARGEST = 10.0

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
