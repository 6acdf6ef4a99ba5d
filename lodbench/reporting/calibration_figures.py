"""Pictures of how well methods know what they found, and of what a number of hypotheses buys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from lodbench.evaluation.calibration import Calibration
from lodbench.reporting.figures import SERIES, draw_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
