"""How cost and memory grow over hypotheses, image size, buildings, queries and workers, and the slopes.

CPU seconds, not those of a clock, so that a busy machine tells the same; slope 1 is a cost in proportion.
"""

from __future__ import annotations

import math
import sys
from dataclasses import astuple, dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from experiments.command import run
from experiments.scale.grown_city import TILE_BUILDINGS
from experiments.scale.slope_points import Reach, points_within
from lodbench.bench import SEED, Figure, Progress, Report, no_progress
from lodbench.errors import ConfigError
from lodbench.params import flag
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.table_heads import finite_text

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure as Canvas


@dataclass(frozen=True, slots=True)
class SlopeOptions:
    """How far each axis goes: by tens from the least, workers by doubling; no size is beyond what is told."""

    hypotheses: int = flag(100_000, "most of a query, from 100 (100000)")
    buildings: int = flag(100_000, "most of a city, from 1,000; a million takes 1.7 GB of the cache (100000)")
    tiled: int = flag(
        10_000, "most compiled from CityGML tiles, from 1,000; a million takes 3 GB of disk (10000)"
    )
    queries: int = flag(10_000, "most of a run, stored and read back, from 10 (10000)")
    workers: int = flag(4, "most processes (4)")
    seed: int = flag(0, SEED)

    def __post_init__(self) -> None:
        least = {"hypotheses": 100, "buildings": TILE_BUILDINGS, "tiled": 1000, "queries": 10, "workers": 1}
        for name, first in least.items():
            if getattr(self, name) < first:
                raise ConfigError(
                    f"{name}={getattr(self, name)} is below where the axis begins.",
                    f"Write --{name} {first}, or more.",
                )


def measure_slopes(options: SlopeOptions | None = None, progress: Progress = no_progress) -> Report:
    """Returns cost over each axis; ``data`` has the columns ``axis``, ``size``, ``cpu_s`` and ``peak_mb``.

    Raises:
        DatasetError: Hardly any view keeps its footprint within the city.
        OSError: The cache cannot be written.
    """
    import pandas as pd

    options = options or SlopeOptions()
    work = list(points_within(Reach(*astuple(options))))
    rows = []
    for number, (axis, size, cost_of) in enumerate(work):
        cost = cost_of()
        rows.append((axis, size, cost.cpu_s, cost.peak_mb))
        progress(number + 1, len(work))
    data = pd.DataFrame(rows, columns=["axis", "size", "cpu_s", "peak_mb"])
    slopes = {str(axis): slope_of(mine) for axis, mine in data.groupby("axis", sort=False)}
    figures = [Figure(f"cpu seconds, {axis} {size:,}", cpu_s, "s") for axis, size, cpu_s, _ in rows]
    figures += [Figure(f"peak memory, {axis} {size:,}", peak_mb, "MB") for axis, size, _, peak_mb in rows]
    figures += [Figure(f"slope over {name}", slope, "") for name, slope in slopes.items()]
    return Report(_text(data, slopes), figures, data, partial(_picture, data, slopes))


def slope_of(points: pd.DataFrame) -> float:
    """Returns the slope of the last half of an axis on doubly logarithmic paper; NaN of a single point."""
    last = points.iloc[-max(2, (len(points) + 1) // 2) :]
    if len(last) < 2:
        return float("nan")
    return float(np.polyfit(np.log(last["size"]), np.log(np.maximum(last["cpu_s"], 1e-9)), 1)[0])


def _text(data: pd.DataFrame, slopes: dict[str, float]) -> str:
    rows = [["axis", "size", "CPU s", "slope", "peak MB"]]
    for axis, points in data.groupby("axis", sort=False):
        for number, point in enumerate(points.itertuples()):
            slope = finite_text(slopes[str(axis)], ".2f") if number == len(points) - 1 else ""
            rows.append([str(axis), f"{point.size:,}", f"{point.cpu_s:.4g}", slope, f"{point.peak_mb:,.0f}"])
    return format_columns(rows) + (
        "\nslope: of the last half of the axis, doubly logarithmic; 1 is in proportion. One thread per "
        "process; 602 x 448 pixels where the axis is another; every point in a process of its own, whose "
        "peak holds Python and the libraries too; that of workers is the sum of theirs."
    )


def _picture(data: pd.DataFrame, slopes: dict[str, float]) -> dict[str, bytes]:
    from matplotlib.ticker import FuncFormatter, NullFormatter

    from lodbench.reporting.figures import SERIES, draw_figure

    groups = list(data.groupby("axis", sort=False))

    def draw(canvas: Canvas) -> None:
        panels = canvas.subplots(2, 4)
        for axes in panels.flat[len(groups) :]:
            axes.set_axis_off()
        for axes, (axis, mine) in zip(panels.flat, groups, strict=False):
            axes.loglog(mine["size"], mine["cpu_s"], "o-", color=SERIES[0])
            axes.set_title(f"{axis}\nslope {finite_text(slopes[str(axis)], '.2f')}", fontsize=8)
            axes.set_ylabel("CPU s", color=SERIES[0])
            beside = axes.twinx()
            # Hollow: where a single size is measured both points lie in the middle.
            beside.loglog(mine["size"], mine["peak_mb"], "s--", color=SERIES[1], markerfacecolor="none", ms=9)
            beside.set_ylabel("peak MB", color=SERIES[1])
            axes.set_xticks(mine["size"])
            for panel, column in ((axes, "cpu_s"), (beside, "peak_mb")):
                # Enough of the other axis that a cost which does not grow looks like one.
                low, high = mine[column].min(), mine[column].max()
                middle = math.sqrt(low * high)
                panel.set_ylim(min(low / 1.5, middle / 10), max(high * 1.5, middle * 10))
                for ruler in (panel.xaxis, panel.yaxis):
                    ruler.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                    ruler.set_minor_formatter(NullFormatter())

    return {f"slopes.{kind}": content for kind, content in draw_figure(12.0, 5.5, draw).items()}


if __name__ == "__main__":
    sys.exit(run("scale.slopes", SlopeOptions, measure_slopes))
