"""How cost grows: CPU seconds over hypotheses, image size, buildings, queries and workers, and the slopes.

CPU seconds, not those of a clock, so that a busy machine tells the same; slope 1 is a cost in proportion.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.bench.figures import Figure, Progress, Report, no_progress
from lodbench.bench.grown_city import TILE_BUILDINGS, grown_city, open_grown_city
from lodbench.bench.scale import ScaleOptions, swarms_inside
from lodbench.bench.scene_opening import open_apart
from lodbench.citymodel.scene_file import read_scene
from lodbench.errors import ConfigError
from lodbench.execution import Ledger
from lodbench.execution.executor import PROCESS, ExecutorParams, spread
from lodbench.geometry import Camera, Pose
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.reporting.aligned_text import format_columns
from lodbench.synthesis.view_sampling import FINE_SIZE, RGB_CAMERA

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure as Canvas

# Hypotheses of an item that workers share.
_ITEM = 500


@dataclass(frozen=True, slots=True)
class SlopeOptions:
    """How far each axis goes.

    Attributes:
        hypotheses: Most hypotheses of a query, from 100 by tens.
        buildings: Most buildings, from 1,000 by tens; a million takes 1.7 GB of the cache.
        queries: Most queries whose answers are stored and read back, from 10 by tens.
        workers: Most processes, from 1 by doubling.
        seed: Of city, views and hypotheses.
    """

    hypotheses: int = 100_000
    buildings: int = 100_000
    queries: int = 10_000
    workers: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        if (
            min(self.hypotheses // 100, self.buildings // TILE_BUILDINGS, self.queries // 10, self.workers)
            < 1
        ):
            raise ConfigError(
                "An axis goes to 100 hypotheses, 1000 buildings, 10 queries, 1 worker at least."
            )


def measure_slopes(options: SlopeOptions | None = None, progress: Progress = no_progress) -> Report:
    """Returns cost over each axis; ``data`` has the columns ``axis``, ``size`` and ``cpu_s``.

    Args:
        options: How far each axis goes.
        progress: Called after each point.

    Raises:
        DatasetError: Hardly any view keeps its footprint within the city.
        OSError: The cache cannot be written.
    """
    import pandas as pd

    options = options or SlopeOptions()
    points = list(_points(options))
    rows = []
    for number, (axis, size, work) in enumerate(points):
        rows.append((axis, size, work()))
        progress(number + 1, len(points))
    data = pd.DataFrame(rows, columns=["axis", "size", "cpu_s"])
    slopes = {str(axis): slope_of(mine) for axis, mine in data.groupby("axis", sort=False)}
    figures = [Figure(f"cpu seconds, {axis} {size:,}", cpu_s, "s") for axis, size, cpu_s in rows]
    figures += [Figure(f"slope over {name}", slope, "") for name, slope in slopes.items()]
    return Report(_text(data, slopes), figures, data, partial(_picture, data, slopes))


def slope_of(points: pd.DataFrame) -> float:
    """Returns the slope of the last half of an axis on doubly logarithmic paper; NaN of a single point."""
    last = points.iloc[-max(2, (len(points) + 1) // 2) :]
    if len(last) < 2:
        return float("nan")
    return float(np.polyfit(np.log(last["size"]), np.log(np.maximum(last["cpu_s"], 1e-9)), 1)[0])


def _points(options: SlopeOptions) -> Iterator[tuple[str, int, Callable[[], float]]]:
    """Yields axis, size and what returns the CPU seconds of every point."""
    engine = SilhouetteRenderer(grown_city(TILE_BUILDINGS, options.seed), 1)
    camera = RGB_CAMERA.scaled(*FINE_SIZE)
    view = ScaleOptions(num_views=1, hypotheses=100, seed=options.seed)
    swarm = swarms_inside(engine, camera, view)[0][0]
    around = swarm.rotations, swarm.centers
    for count in _steps(100, options.hypotheses, 10):
        yield "hypotheses", count, partial(_score, engine, camera, swarm.pose, around, count)
    for width in (150, 300, 600, 1200):
        small = camera.scaled(width, round(width * camera.height / camera.width))
        yield "image width, px", width, partial(_score, engine, small, swarm.pose, around, 1000)
    for buildings in _steps(TILE_BUILDINGS, options.buildings, 10):
        yield "buildings, opened", buildings, partial(_open, buildings, options.seed)
    for buildings in _steps(TILE_BUILDINGS, options.buildings, 10):
        yield (
            "buildings, 1000 hypotheses",
            buildings,
            partial(_score_in, buildings, options.seed, swarm.pose, around),
        )
    for queries in _steps(10, options.queries, 10):
        yield "queries stored and read", queries, partial(_store, queries)
    for workers in _steps(1, options.workers, 2):
        yield (
            "workers, 16,000 hypotheses",
            workers,
            partial(_share, workers, options.seed, swarm.pose, around),
        )


def _steps(first: int, last: int, factor: int) -> list[int]:
    sizes = [first]
    while sizes[-1] * factor <= last:
        sizes.append(sizes[-1] * factor)
    return sizes


Around = tuple[NDArray[np.float64], NDArray[np.float64]]


def _score(engine: SilhouetteRenderer, camera: Camera, pose: Pose, around: Around, count: int) -> float:
    """Returns the CPU seconds of so many hypotheses, those around a pose again and again."""
    mask = engine.render(camera, pose)
    turns = np.arange(count) % len(around[1])
    rotations, centers = around[0][turns], around[1][turns]
    engine.counts(camera, rotations[:1], centers[:1], mask)
    started = time.process_time()
    engine.counts(camera, rotations, centers, mask)
    return time.process_time() - started


def _score_in(buildings: int, seed: int, pose: Pose, around: Around) -> float:
    engine = SilhouetteRenderer(read_scene(open_grown_city(buildings, seed))[0], 1)
    return _score(engine, RGB_CAMERA.scaled(*FINE_SIZE), pose, around, 1000)


def _open(buildings: int, seed: int) -> float:
    folder = open_grown_city(buildings, seed)
    SilhouetteRenderer(read_scene(folder)[0], 1)  # laid out and stored the first time
    return open_apart(folder).cpu_s


def _store(queries: int) -> float:
    """Returns the CPU seconds of storing answers one by one, as a run does, and reading them back."""
    answer = {"pose": [0.125] * 7, "failure": "", "score": 0.5, "hypotheses": 500, "seconds": {"coarse": 0.1}}
    with tempfile.TemporaryDirectory() as folder:
        started = time.process_time()
        ledger = Ledger(Path(folder) / "predictions.jsonl")
        for number in range(queries):
            ledger.record(f"split/{number}.png", answer)
        Ledger(Path(folder) / "predictions.jsonl")
        return time.process_time() - started


# What a worker has opened.
_here: list[tuple[SilhouetteRenderer, Pose, Around]] = []


def _share(workers: int, seed: int, pose: Pose, around: Around) -> float:
    """Returns the CPU seconds of all processes together, opening included: what workers cost besides."""
    folder = open_grown_city(TILE_BUILDINGS, seed)
    executor = ExecutorParams(PROCESS, workers=workers)
    started = time.process_time()
    used: dict[int, float] = {os.getpid(): 0.0}
    for worker, cpu_s in spread(executor, _item, range(16_000 // _ITEM), _begin, (folder, pose, around)):
        used[worker] = max(used.get(worker, 0.0), cpu_s)
    used[os.getpid()] = time.process_time() - started
    return sum(used.values())


def _begin(folder: Path, pose: Pose, around: Around) -> None:
    _here[:] = [(SilhouetteRenderer(read_scene(folder)[0], 1), pose, around)]


def _item(_: int) -> tuple[int, float]:
    """Returns which process scored an item, and the CPU seconds it has used since it started."""
    engine, pose, around = _here[0]
    _score(engine, RGB_CAMERA.scaled(*FINE_SIZE), pose, around, _ITEM)
    return os.getpid(), time.process_time()


def _text(data: pd.DataFrame, slopes: dict[str, float]) -> str:
    rows = [["axis", "size", "CPU s", "slope"]]
    for axis, points in data.groupby("axis", sort=False):
        for number, point in enumerate(points.itertuples()):
            slope = f"{slopes[str(axis)]:.2f}" if number == len(points) - 1 else ""
            rows.append([str(axis), f"{point.size:,}", f"{point.cpu_s:.4g}", slope])
    return format_columns(rows) + (
        "\nslope: of the last half of the axis, doubly logarithmic; 1 is in proportion. One thread per "
        "process; 602 x 448 pixels where the axis is another; opening in a process of its own."
    )


def _picture(data: pd.DataFrame, slopes: dict[str, float]) -> dict[str, bytes]:
    from matplotlib.ticker import FuncFormatter, NullFormatter

    from lodbench.reporting.figures import SERIES, draw_figure

    groups = list(data.groupby("axis", sort=False))

    def draw(canvas: Canvas) -> None:
        for axes, (axis, points) in zip(canvas.subplots(2, 3).flat, groups, strict=True):
            axes.loglog(points["size"], points["cpu_s"], "o-", color=SERIES[0])
            axes.set_title(f"{axis}\nslope {slopes[str(axis)]:.2f}", fontsize=9)
            axes.set_ylabel("CPU s")
            axes.set_xticks(points["size"])
            # Enough of the other axis that a cost which does not grow looks like one.
            low, high = points["cpu_s"].min(), points["cpu_s"].max()
            middle = math.sqrt(low * high)
            axes.set_ylim(min(low / 1.5, middle / 10), max(high * 1.5, middle * 10))
            for ruler in (axes.xaxis, axes.yaxis):
                ruler.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                ruler.set_minor_formatter(NullFormatter())

    return {f"slopes.{kind}": content for kind, content in draw_figure(9.0, 5.0, draw).items()}
