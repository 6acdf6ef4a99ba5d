"""Figures by matplotlib, the same bytes from the same numbers: calibration, basins, costs, errors, tests."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.evaluation.metrics import Calibration
from lodbench.evaluation.pose_errors import Agreement, Apart, Comparison, SplitSummary
from lodbench.reporting.aligned_text import count_of, format_columns, plain_text
from lodbench.reporting.table_heads import finite_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Lines of splits, to be cycled through.
LINE_STYLES = ("-", "--", ":", "-.")
# Told apart with any colour vision, and in grey by their order (after Okabe and Ito).
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    # Letters stay text: small files, and a page that can be searched.
    "svg.fonttype": "none",
    # Ids come from this instead of from chance.
    "svg.hashsalt": "lodbench",
    "savefig.facecolor": "white",
    # Names come from anywhere: a pair of dollar signs is no formula.
    "text.parse_math": False,
}
Floats = NDArray[np.float64]
PRIOR, ESTIMATE, _INK = SERIES[1], SERIES[0], "#222222"
# Where a camera error stops mattering: beyond this it is just lost.
_FURTHEST_M, _FURTHEST_DEG = 100.0, 180.0
# Evidence is drawn evenly as far as this, and by its logarithm from there on.
_LINEAR_NATS = 10.0
# Of traces that are no beam's, in turn.
_DASHES = (":", "-.", "--")
# Of differences on a terminal; a page has all of them.
_MOST_LINES = 20
PAIRED_NOTE = (
    "Paired by query. Recall: exact McNemar test, interval of Bonett and Price. Medians: permutation "
    "test (1,999 swaps), bootstrap over queries. No correction for the number of tests."
)
_LARGEST = 10.0
# Of runs in turn: the first two are those of A and B on maps and photos. Orange is the prior
# everywhere.
_OF_RUNS = (SERIES[0], SERIES[4], SERIES[2], SERIES[3], SERIES[5])


def draw_figure(width_in: float, height_in: float, draw: Callable[[Figure], None]) -> dict[str, bytes]:
    """Returns a figure as ``{"png": ..., "svg": ...}``."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE), warnings.catch_warnings():
        # Names of the world's scripts: a box stands for a letter that the font lacks, in the picture only.
        warnings.filterwarnings("ignore", "Glyph", UserWarning)
        # No pyplot: it would choose a window system, and keep every figure.
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        FigureCanvasAgg(figure)
        draw(figure)
        pictures = {}
        for kind, metadata in (("png", {"Software": None}), ("svg", {"Date": None, "Creator": None})):
            stream = io.BytesIO()
            figure.savefig(stream, format=kind, dpi=160, metadata=metadata)
            pictures[kind] = stream.getvalue()
            # Laid out once, for both.
            figure.set_layout_engine("none")
    return pictures


class BudgetPoint(NamedTuple):
    """Recall at a number of hypotheses: mean per query, percent found and its 95 % interval."""

    hypotheses: float
    recall: float
    low: float
    high: float


def draw_calibration(curves: Mapping[str, Calibration]) -> dict[str, bytes]:
    """Returns the reliability diagram beside the risk over coverage, as PNG and SVG."""

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        for colour, (name, calibration) in zip(SERIES * len(curves), curves.items(), strict=False):
            # Numbers of the first method stand below its marks, of the next above theirs.
            _reliability(left, calibration, colour, 5 if list(curves).index(name) % 2 else -9)
            label = f"{name}, AURC {100 * calibration.aurc:.1f} %"
            right.plot(100 * calibration.coverage, 100 * calibration.risk, color=colour, label=label)
        left.plot([0, 100], [0, 100], color="0.6", linewidth=0.8, zorder=0)
        left.set(
            xlabel="confidence: probability of being within 2 m, 2 deg (%)",
            ylabel="found within 2 m, 2 deg (%)",
            xlim=(0, 106),
        )
        left.set(ylim=(0, 106), title="Reliability: queries per mark beside it")
        right.set(
            xlabel="queries answered, most confident first (%)", ylabel="answers not within 2 m, 2 deg (%)"
        )
        right.set(xlim=(0, 100), title="Risk over coverage")
        right.set_ylim(bottom=0)
        right.legend(loc="upper left")

    return draw_figure(8.4, 3.6, draw)


def draw_budget(panels: Mapping[str, Mapping[str, Sequence[BudgetPoint]]]) -> dict[str, bytes]:
    """Returns recall over poses drawn, panels side by side, one line a method, as PNG and SVG.

    A method that draws none is a dashed line. Where colours come again marks and dashes are others.
    """

    def draw(figure: Figure) -> None:
        from matplotlib.ticker import LogLocator, NullLocator

        names = list(dict.fromkeys(name for curves in panels.values() for name in curves))
        row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (title, curves) in zip(row, panels.items(), strict=True):
            for name, points in curves.items():
                turn, colour = divmod(names.index(name), len(SERIES))
                mark, dashes = "os^Dv*"[turn % 6], ("--", ":", "-.")[turn % 3]
                _budget_curve(axes, name, points, SERIES[colour], mark, dashes)
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1,) if len(panels) > 1 else (1, 2, 5)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_locator(NullLocator())
            axes.set(xlabel="poses drawn per query", ylim=(-2, 104), title=title)
        row[0].set(ylabel="within 2 m, 2 deg (%)")
        if len(names) > 3:
            handles = {each.get_label(): each for axes in row for each in axes.get_lines()}
            figure.legend(handles.values(), handles, loc="outside right upper")
        else:
            row[0].legend(loc="lower left")

    wide = 5.6 if len(panels) == 1 else 3.6 * len(panels)
    return draw_figure(wide + (1.9 if len(panels) > 1 else 0.0), 3.6, draw)


def _budget_curve(
    axes: Axes, name: str, points: Sequence[BudgetPoint], colour: str, mark: str, dashes: str
) -> None:
    drawn = [point for point in points if point.hypotheses > 0]
    for point in points:
        if point.hypotheses <= 0:
            axes.axhline(point.recall, color=colour, linestyle=dashes, linewidth=1, label=name)
    if drawn:
        x = [point.hypotheses for point in drawn]
        axes.plot(x, [p.recall for p in drawn], color=colour, marker=mark, markersize=4, label=name)
        low, high = [p.low for p in drawn], [p.high for p in drawn]
        if len(drawn) > 1:
            axes.fill_between(x, low, high, color=colour, alpha=0.12, linewidth=0)
        else:
            axes.vlines(x, low, high, color=colour, alpha=0.5, linewidth=1)


def _reliability(axes: Axes, calibration: Calibration, colour: str, number_offset: int) -> None:
    confidence = [100 * b.confidence for b in calibration.bins]
    shares = [100 * b.hit_share for b in calibration.bins]
    below = [100 * (b.hit_share - b.interval[0]) for b in calibration.bins]
    above = [100 * (b.interval[1] - b.hit_share) for b in calibration.bins]
    axes.errorbar(confidence, shares, yerr=[below, above], color=colour, fmt="o", markersize=4, linewidth=1)
    for x, y, b in zip(confidence, shares, calibration.bins, strict=True):
        axes.annotate(
            str(b.count), (x, y), (4, number_offset), textcoords="offset points", fontsize=7, color=colour
        )


class RecallCurve(NamedTuple):
    """Recalls of one split over the half widths of one kind of error."""

    split: str
    half_widths: tuple[float, ...]
    summaries: tuple[SplitSummary, ...]


def draw_recall_curves(panels: Sequence[tuple[str, Sequence[RecallCurve]]]) -> dict[str, bytes]:
    """Returns the figure of recalls, one panel per kind of error, whiskers being 95 % intervals."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        for axis, (label, curves) in zip(axes, panels, strict=True):
            for style, curve in zip(cycle(LINE_STYLES), curves, strict=False):
                _draw_curve(axis, curve, style, len(curves) > 1)
            axis.set(xlabel=label, ylim=(0, 103))
            axis.set_xticks(curves[0].half_widths, [f"{width:g}" for width in curves[0].half_widths])
        axes[0].set_ylabel("recall, %")
        if splits > 1:
            handles = axes[0].get_legend_handles_labels()
            figure.legend(*handles, loc="outside lower center", ncols=min(splits, 2 * len(panels)))
        else:
            axes[-1].legend(loc="lower left")

    splits = max(len(curves) for _, curves in panels)
    return draw_figure(3.6 * len(panels) + 0.4, 3.0 if splits == 1 else 3.2 + 0.3 * splits, draw)


def _draw_curve(axis: Axes, curve: RecallCurve, style: str, with_name: bool) -> None:
    labelled = list(enumerate(zip(SERIES, curve.summaries[0].recall, strict=False)))
    # The loosest first and largest: curves that fall together all stay in sight.
    for number, (colour, label) in reversed(labelled):
        recall = np.array([summary.recall[label] for summary in curve.summaries])
        ends = np.array([summary.interval[label] for summary in curve.summaries]).T
        whiskers = np.abs(ends - recall)
        name = f"{label}, {curve.split}" if with_name else label
        axis.errorbar(
            curve.half_widths,
            recall,
            whiskers,
            color=colour,
            linestyle=style,
            marker="o",
            markersize=4 + 3 * number,
            capsize=2,
            label=name,
        )


def draw_cost_maps(
    num_queries: int,
    xy_m: Floats,
    xy: Floats,
    z: tuple[Floats, Floats, Floats],
    yaw: tuple[Floats, Floats, Floats],
) -> dict[str, bytes]:
    """Returns the figure of average IoU around the truth.

    Args:
        num_queries: Queries averaged over.
        xy_m: (N,) offsets along x and along y.
        xy: (N, N) mean IoU, rows along y.
        z: Offsets in metres, mean IoU, and its standard deviation over queries.
        yaw: The same over degrees.
    """

    def draw(figure: Figure) -> None:
        plane, height, turn = figure.subplots(1, 3, width_ratios=(1.25, 1, 1))
        half_step = (xy_m[1] - xy_m[0]) / 2
        edges = (xy_m[0] - half_step, xy_m[-1] + half_step)
        image = plane.imshow(xy, origin="lower", extent=(*edges, *edges), cmap="viridis", vmin=0)
        plane.plot(0, 0, "+", color="white", markersize=8)
        plane.grid(visible=False)
        plane.set(xlabel="east of the truth, m", ylabel="north of the truth, m", title="x-y")
        figure.colorbar(image, ax=plane, label="mean IoU", shrink=0.85)
        for axis, (offsets, mean, spread), label, title in (
            (height, z, "above the truth, m", "z"),
            (turn, yaw, "turned from the truth, deg", "yaw"),
        ):
            axis.fill_between(offsets, mean - spread, mean + spread, color=SERIES[0], alpha=0.2, linewidth=0)
            axis.plot(offsets, mean, color=SERIES[0])
            axis.axvline(0, color="0.5", linewidth=0.8, linestyle=":")
            axis.set(xlabel=label, title=title, ylim=(0, 1), xlim=(offsets[0], offsets[-1]))
        height.set_ylabel("IoU: mean and standard deviation")
        figure.suptitle(
            f"Average IoU with the query mask around the truth, {count_of(num_queries, 'queries')}",
            fontsize=10,
        )

    return draw_figure(10.2, 3.3, draw)


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


def agreement_text(agreement: Agreement | None) -> str:
    """Returns in words how far the answers of two runs lie apart; "" where no query has two."""
    if agreement is None:
        return ""
    return (
        f"Both runs answered {count_of(agreement.answered, 'queries')}; {agreement.within} within 2 m and "
        f"2 deg of each other; median difference {agreement.median_m:.2f} m ({agreement.median_plan_m:.2f} m "
        f"in plan, {agreement.median_height_m:.2f} m in height) and {agreement.median_deg:.2f} deg."
    )


def format_apart(differences: Mapping[str, Apart]) -> str:
    """Returns how far answers to the same photos lie apart, a line each, those furthest apart first."""
    ranked = sorted(differences.items(), key=lambda item: (-item[1].error.translation_m, item[0]))
    rows = [["", "apart m", "apart deg", "in plan m", "in height m"]]
    for key, ((metres, degrees), parts) in ranked[:_MOST_LINES]:
        numbers = [f"{metres:.2f}", f"{degrees:.2f}", f"{parts.horizontal_m:.2f}", f"{parts.vertical_m:+.2f}"]
        rows.append([plain_text(key), *numbers])
    left = len(differences) - _MOST_LINES
    more = f"\n{count_of(left, 'more photos')}: --out compared.html shows all" if left > 0 else ""
    return f"{format_columns(rows)}{more}"


def _p_text(p: float) -> str:
    if not math.isfinite(p):
        return "-"
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


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
