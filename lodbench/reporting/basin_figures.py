"""The two figures of a convergence basin: recall over the prior's error, and cost around the truth."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.evaluation.recall import SplitSummary
from lodbench.reporting.aligned_text import count_of
from lodbench.reporting.figures import LINE_STYLES, SERIES, draw_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]


class RecallCurve(NamedTuple):
    """Recalls of one split over the half widths of one kind of error."""

    split: str
    half_widths: tuple[float, ...]
    summaries: tuple[SplitSummary, ...]


def draw_recall_curves(panels: Sequence[tuple[str, Sequence[RecallCurve]]]) -> dict[str, bytes]:
    """Returns the figure of recalls, one panel per kind of error, whiskers being 95 % intervals.

    Args:
        panels: Axis label and the curves of its splits.
    """

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
