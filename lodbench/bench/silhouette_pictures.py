"""Pictures of the silhouette figures: how costs and ratios spread over the views."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.bench.silhouette_report import SilhouetteReport, Timing
from lodbench.storage import write_bytes

# Distinguishable without colour vision (Okabe and Ito 2008).
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
_DPI = 150

# For each column of dots a name, a number per view, and the report's number for all of them.
Columns = list[tuple[str, tuple[float, ...], float]]


def write_pictures(report: SilhouetteReport, folder: Path) -> list[Path]:
    """Writes ``costs.png`` and, where there are peers, ``ratios.png``; returns the files.

    Raises:
        OSError: The folder cannot be made or written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / "costs.png"]
    write_bytes(files[0], _picture(report, _costs, "microseconds per hypothesis, one dot per view"))
    if any(report.peers_of(timing) for timing in report.ours):
        files.append(folder / "ratios.png")
        write_bytes(files[1], _picture(report, _ratios, "times faster than the peer, one dot per view"))
    return files


def _picture(
    report: SilhouetteReport, columns: Callable[[SilhouetteReport, list[Timing]], Columns], label: str
) -> bytes:
    """Returns a PNG with a panel for each size and kind of views."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullLocator

    groups = list(dict.fromkeys((t.size, t.views) for t in report.timings))
    figure = Figure(figsize=(1.2 + 4.2 * len(groups), 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for axis, group in zip(axes, groups, strict=True):
        mine = [t for t in report.timings if (t.size, t.views) == group]
        _strips(axis, columns(report, mine))
        axis.set_yscale("log")
        axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.yaxis.set_major_formatter("{x:,.0f}")
        axis.yaxis.set_minor_locator(NullLocator())
        axis.set_title(f"{group[0][0]} x {group[0][1]}, {group[1]} deg", fontsize=10)
        axis.grid(axis="y", alpha=0.25)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    axes[0].set_ylabel(label)
    content = io.BytesIO()
    figure.savefig(content, dpi=_DPI, format="png")
    return content.getvalue()


def _costs(report: SilhouetteReport, timings: list[Timing]) -> Columns:
    return [(t.name, t.microseconds, t.mean) for t in timings]


def _ratios(report: SilhouetteReport, timings: list[Timing]) -> Columns:
    return [
        (f"{ours.name}, beside {peer.renderer}", ours.times_faster(peer), peer.mean / ours.mean)
        for ours in timings
        if ours.threads is not None
        for peer in report.peers_of(ours)
    ]


def _strips(axis: Any, columns: Columns) -> None:
    """Draws a column of dots for each name, with a bar at the report's number."""
    for i, (_, values, overall) in enumerate(columns):
        colour = _COLOURS[i % len(_COLOURS)]
        places = i + 0.28 * (np.argsort(np.argsort(values)) / max(1, len(values) - 1) - 0.5)
        axis.plot(places, values, "o", color=colour, markersize=3.5, alpha=0.75, markeredgewidth=0)
        axis.hlines(overall, i - 0.42, i + 0.42, color=colour, linewidth=1.5)
        axis.annotate(f"{overall:,.0f}", (i - 0.42, overall), (0, 3), textcoords="offset points",
                      fontsize=8, color=colour)  # fmt: skip
    names = [name.replace(", ", "\n") for name, _, _ in columns]
    axis.set_xticks(range(len(columns)), names, fontsize=7)
    axis.set_xlim(-0.6, len(columns) - 0.4)
