"""Curves of several methods over the same queries: recall over its threshold, and how errors spread."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.reporting.figures import LINE_STYLES, SERIES, draw_figure
from lodbench.reporting.run_figures import PRIOR, shares_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
