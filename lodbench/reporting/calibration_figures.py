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
    """Returns the reliability diagram beside the risk over coverage, as PNG and SVG.

    Args:
        curves: By the name to show.
    """

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
        right.set(xlabel="queries answered, surest first (%)", ylabel="answers not within 2 m, 2 deg (%)")
        right.set(xlim=(0, 100), title="Risk when unsure queries are declined")
        right.set_ylim(bottom=0)
        right.legend(loc="upper left")

    return draw_figure(8.4, 3.6, draw)


def draw_budget(curves: Mapping[str, Sequence[BudgetPoint]], title: str) -> dict[str, bytes]:
    """Returns recall over hypotheses rendered, one line a method, as PNG and SVG.

    Args:
        curves: By the name to show, fewest hypotheses first.
        title: What was measured.
    """

    def draw(figure: Figure) -> None:
        from matplotlib.ticker import LogLocator, NullLocator

        axes = figure.subplots()
        for colour, (name, points) in zip(SERIES * len(curves), curves.items(), strict=False):
            x = [point.hypotheses for point in points]
            axes.plot(x, [p.recall for p in points], color=colour, marker="o", markersize=4, label=name)
            low, high = [p.low for p in points], [p.high for p in points]
            axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set(xlabel="hypotheses rendered per query", ylabel="within 2 m, 2 deg (%)", ylim=(0, 102))
        axes.set_title(title)
        axes.legend(loc="lower left")

    return draw_figure(5.6, 3.6, draw)


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
