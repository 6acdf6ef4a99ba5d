"""The silhouette figures as text, data and pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lodbench.bench.figures import Figure, Report
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.figures import SERIES, draw_figure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

# Kinds of views, named by their pitch from nadir.
STEEP = "pitch 20 to 60"
HORIZON = "pitch 60 to 75"


class Timing(NamedTuple):
    """One renderer on one kind of views at one size.

    Attributes:
        name: The renderer, and the engine's threads in words.
        is_peer: Whether it stands beside the engine.
        size: ``602x448``, the mask in pixels.
        views: ``STEEP`` or ``HORIZON``.
        us: (N,) microseconds per hypothesis, rendering and IoU together, a number per view.
        cores: Cores the process kept busy: its CPU time over wall time.
        different: Share of pixels that differ from the engine's picture of the views themselves.
    """

    name: str
    is_peer: bool
    size: str
    views: str
    us: pd.Series[float]
    cores: float
    different: float

    @property
    def mean(self) -> float:
        """Returns microseconds per hypothesis over all views."""
        return float(self.us.mean())

    @property
    def where(self) -> str:
        """Returns the size, with the kind of views unless they are the usual ones."""
        return self.size if self.views == STEEP else f"{self.size}, {self.views}"


def report_silhouettes(
    data: pd.DataFrame, rejections: Mapping[str, int], absent: Mapping[str, str], *notes: str
) -> Report:
    """Returns the report of timings.

    Args:
        data: A row per renderer, size and view, with the columns ``name``, ``is_peer``, ``size``, ``views``,
            ``us``, ``cores`` and ``different``: as of ``Timing``, but a number each.
        rejections: By kind of views, draws of a view thrown away: too few or too many buildings, or among
            them.
        absent: Peers that could not run, and why.
        notes: Lines to close with.
    """
    keys = ["name", "is_peer", "size", "views"]
    timings = [
        Timing(name, is_peer, size, kind, rows["us"], rows["cores"].mean(), rows["different"].mean())
        for _, rows in data.groupby(keys, sort=False)
        for name, is_peer, size, kind in [rows[keys].iloc[0]]
    ]
    views = {t.views: len(t.us) for t in timings}
    drawn = [f"{n} views of {kind} deg ({rejections[kind]} draws rejected)" for kind, n in views.items()]
    lines = [
        _table(timings),
        *(
            f"{b.name}: {b.where} takes {b.mean / a.mean:.2f} of the time of {a.where}, "
            f"{a.mean / b.mean:.2f}x as fast."
            for a, b in _size_pairs(timings)
        ),
        f"{', '.join(drawn)}.",
        *notes,
        *(
            f"{t.name} at {t.where}: {t.different:.2%} of pixels differ from the engine's."
            for t in timings
            if t.is_peer
        ),
        *(f"{name} is absent: {reason}" for name, reason in absent.items()),
    ]
    rejected = [Figure(f"views rejected, {kind}", count, "") for kind, count in rejections.items()]
    figures = [*_figures(timings, absent), *rejected]
    return Report("\n".join(lines), figures, data, partial(_pictures, timings))


def _peers_of(timing: Timing, timings: list[Timing]) -> list[Timing]:
    """Returns the peers' timings at the same size on the same views."""
    return [t for t in timings if t.is_peer and (t.size, t.views) == (timing.size, timing.views)]


def _size_pairs(timings: list[Timing]) -> Iterator[tuple[Timing, Timing]]:
    """Yields pairs of the engine's timings: at the first size, and at each other on the same views."""
    first = timings[0].size
    for t in timings:
        if not t.is_peer and t.size != first:
            yield next(f for f in timings if (f.name, f.size, f.views) == (t.name, first, t.views)), t


def _figures(timings: list[Timing], absent: Mapping[str, str]) -> Iterator[Figure]:
    """Yields the engine's time beside each peer's; an absent peer is named with the reason."""
    for t in timings:
        if t.is_peer:
            continue
        title, peers = f"render and IoU, {t.where}, {t.name}", _peers_of(t, timings)
        yield from (Figure(title, t.mean, "us", p.name, p.mean, p.mean / t.mean) for p in peers)
        yield from (Figure(title, t.mean, "us", f"{name} ({why})") for name, why in absent.items())
        if not peers and not absent:
            yield Figure(title, t.mean, "us")
    for a, b in _size_pairs(timings):
        title = f"render and IoU, {b.where} beside {a.where}, {b.name}"
        yield Figure(title, b.mean, "us", a.where, a.mean, a.mean / b.mean)
    yield from (Figure(f"cores kept busy, {t.where}, {t.name}", t.cores, "cores") for t in timings)
    for t in timings:
        if t.is_peer:
            yield Figure(f"pixels unlike {t.name}, {t.where}", t.different * 100, "%")


def _table(timings: list[Timing]) -> str:
    peers = list(dict.fromkeys(t.name for t in timings if t.is_peer))
    head = ["render and IoU", "size", "us/hypothesis", "fastest view", "slowest view", "cores busy"]
    rows = [[*head, *(f"x {name}" for name in peers)]]
    for t in timings:
        faster = {peer.name: f"{peer.mean / t.mean:.1f}" for peer in _peers_of(t, timings)}
        spread = [f"{value:.1f}" for value in (t.mean, t.us.min(), t.us.max())]
        rows.append([t.name, t.where, *spread, f"{t.cores:.2f}", *(faster.get(name, "") for name in peers)])
    return format_columns(rows)


def _pictures(timings: list[Timing]) -> dict[str, bytes]:
    """Returns how costs, and where there are peers ratios, spread over the views."""
    drawn = {"costs": draw_figure(*_strips(timings, _costs, "microseconds per hypothesis, one dot per view"))}
    if any(t.is_peer for t in timings):
        label = "times faster than the peer, one dot per view"
        drawn["ratios"] = draw_figure(*_strips(timings, _ratios, label))
    return {f"{name}.{kind}": content for name, kinds in drawn.items() for kind, content in kinds.items()}


# For each column of dots a name, a number per view, and the report's number for all of them.
Columns = list[tuple[str, Any, float]]


def _costs(timings: list[Timing]) -> Columns:
    return [(t.name, t.us.to_numpy(), t.mean) for t in timings]


def _ratios(timings: list[Timing]) -> Columns:
    return [
        (f"{t.name}, beside {peer.name}", peer.us.to_numpy() / t.us.to_numpy(), peer.mean / t.mean)
        for t in timings
        if not t.is_peer
        for peer in _peers_of(t, timings)
    ]


def _strips(
    timings: list[Timing], columns: Callable[[list[Timing]], Columns], label: str
) -> tuple[float, float, Callable[[Canvas], None]]:
    """Returns the width, the height and the drawing of a panel for each size and kind of views."""
    groups = list(dict.fromkeys((t.size, t.views) for t in timings))

    def draw(canvas: Canvas) -> None:
        from matplotlib.ticker import LogLocator, NullLocator

        axes = canvas.subplots(1, len(groups), sharey=True, squeeze=False)[0]
        for axis, (size, views) in zip(axes, groups, strict=True):
            _draw_dots(axis, columns([t for t in timings if (t.size, t.views) == (size, views)]))
            axis.set_yscale("log")
            axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.yaxis.set_major_formatter("{x:,.0f}")
            axis.yaxis.set_minor_locator(NullLocator())
            axis.set_title(f"{size}, {views} deg")
        axes[0].set_ylabel(label)

    return 1.2 + 4.2 * len(groups), 4.2, draw


def _draw_dots(axis: Axes, columns: Columns) -> None:
    """Draws a column of dots for each name, with a bar at the report's number."""
    for i, (_, values, overall) in enumerate(columns):
        colour = SERIES[i % len(SERIES)]
        places = i + 0.28 * (np.argsort(np.argsort(values)) / max(1, len(values) - 1) - 0.5)
        axis.plot(places, values, "o", color=colour, markersize=3.5, alpha=0.75, markeredgewidth=0)
        axis.hlines(overall, i - 0.42, i + 0.42, color=colour, linewidth=1.5)
        axis.annotate(f"{overall:,.0f}", (i - 0.42, overall), (0, 3), textcoords="offset points",
                      fontsize=8, color=colour)  # fmt: skip
    axis.set_xticks(range(len(columns)), [name.replace(", ", "\n") for name, _, _ in columns], fontsize=7)
    axis.set_xlim(-0.6, len(columns) - 0.4)
