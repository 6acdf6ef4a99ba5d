"""Figures by matplotlib, the same bytes from the same numbers: their look; calibration, basins, cost."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.evaluation.metrics import Calibration
from lodbench.evaluation.pose_errors import SplitSummary
from lodbench.reporting.aligned_text import count_of

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
    found = [100 * b.found for b in calibration.bins]
    below = [100 * (b.found - b.interval[0]) for b in calibration.bins]
    above = [100 * (b.interval[1] - b.found) for b in calibration.bins]
    axes.errorbar(confidence, found, yerr=[below, above], color=colour, fmt="o", markersize=4, linewidth=1)
    for x, y, b in zip(confidence, found, calibration.bins, strict=True):
        axes.annotate(
            str(b.count), (x, y), (4, number_offset), textcoords="offset points", fontsize=7, color=colour
        )


Floats = NDArray[np.float64]


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
