"""What a hypothesis costs in a city of a million buildings, beside the same views of its core alone.

Views whose whole field of view meets the ground inside the core show the same in both cities: every
count must agree, and any difference in time is the price of the buildings that are not seen. Views to
the horizon show more of the larger city, and are reported apart.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from experiments.scale.grown_city import TILE_BUILDINGS, grown_city, open_grown_city
from experiments.scale.opening import Opening, open_apart
from lodbench.bench import SEED, Figure, Progress, Report, no_progress
from lodbench.bench.silhouettes import Swarm, make_swarm
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.scene_file import read_scene
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import Camera
from lodbench.params import flag
from lodbench.rendering.silhouette import SilhouetteRenderer, arrays_folder
from lodbench.reporting.aligned_text import format_columns
from lodbench.synthesis.views import FINE_SIZE, RGB_CAMERA, ViewSampling, sample_views

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]

STEEP_DEG = (20.0, 60.0)
HORIZON_DEG = (60.0, 75.0)
# Views aim near the middle, or few would keep their footprint within the core.
_AIM_M = (-150.0, -150.0, 150.0, 150.0)
_MAX_DRAWS_PER_VIEW = 50


@dataclass(frozen=True, slots=True)
class ScaleOptions:
    """What to measure.

    Attributes:
        horizon_hypotheses: Around each view to the horizon, which shows a good part of the whole city.
        repeats: Passes over each view, the cities in turn; the fastest counts.
    """

    buildings: int = flag(
        1_000_000, "of the large city, its core the first 1,000; a million takes 1.7 GB (1000000)"
    )
    num_views: int = flag(
        10, "seeded views of each kind: in the core, to the horizon (10)", "--views", metavar="VIEWS"
    )
    hypotheses: int = flag(400, "around each view (400)")
    horizon_hypotheses: int = 13
    repeats: int = 3
    seed: int = flag(0, SEED)

    def __post_init__(self) -> None:
        if self.buildings < TILE_BUILDINGS:
            raise ConfigError(f"buildings={self.buildings}: the core alone has {TILE_BUILDINGS}.")
        if min(self.num_views, self.hypotheses, self.horizon_hypotheses, self.repeats) < 1:
            raise ConfigError("num_views, hypotheses, horizon_hypotheses and repeats are at least 1.")


def measure_scale(options: ScaleOptions | None = None, progress: Progress = no_progress) -> Report:
    """Returns what a large city costs: to open, on disk, and per hypothesis beside its core.

    The large city is made and stored in the cache when it is not there. ``data`` is what ``time_views``
    returns.

    Raises:
        DatasetError: Hardly any view keeps its footprint within the core.
        OSError: The cache cannot be written.
    """
    import pandas as pd

    options = options or ScaleOptions()
    started = time.perf_counter()
    folder = open_grown_city(options.buildings, options.seed, progress)
    # Lays the scene out for the engine and stores that too, unless it is there.
    whole = SilhouetteRenderer(read_scene(folder)[0], 1)
    making = time.perf_counter() - started
    opening = open_apart(folder)
    core = SilhouetteRenderer(grown_city(TILE_BUILDINGS, options.seed), 1)
    camera = RGB_CAMERA.scaled(*FINE_SIZE)
    inside, rejections = swarms_inside(core, camera, options)
    few = replace(options, hypotheses=options.horizon_hypotheses)
    horizon = _swarms(core, camera, few, HORIZON_DEG, options.num_views)[0]
    timings = pd.concat(
        time_views(name, core, whole, camera, swarms, options.repeats, progress)
        for name, swarms in (("footprint in the core", inside), ("to the horizon", horizon))
    )
    disk_mb = _size_mb(folder) + _size_mb(arrays_folder(whole.scene))
    text = (
        f"{options.buildings:,} buildings, {len(whole.scene.triangles):,} triangles, beside their first "
        f"thousand.\n{options.num_views} views of each kind ({rejections} rejected), {options.hypotheses} "
        f"hypotheses around each ({options.horizon_hypotheses} to the horizon), one thread, best pass per "
        f"view, the cities in turn.\nOpened in {opening.seconds:.2f} s, resident then {_memory(opening)}; "
        f"{disk_mb:,.0f} MB on disk; made or found in {making:.1f} s."
    )
    figures = [*figures_of(timings, options.buildings), Figure("opening", opening.seconds, "s")]
    if opening.resident_mb is not None:
        figures.append(Figure("resident once open", opening.resident_mb, "MB"))
    figures += [Figure("on disk", disk_mb, "MB"), Figure("views rejected", rejections, "")]
    return Report(f"{_table(timings)}\n{text}", figures, timings)


def figures_of(timings: pd.DataFrame, buildings: int) -> list[Figure]:
    """Returns the costs in the whole city beside those in its core, by kind of views."""
    figures = []
    for name, mine in timings.groupby("views", sort=False):
        core, whole = mine["core_us"].mean(), mine["whole_us"].mean()
        title = f"render and IoU, {buildings:,} buildings, {name}"
        figures.append(Figure(title, whole, "us", "the core alone", core, core / whole))
        figures.append(Figure(f"hypotheses that count differently, {name}", int(mine["different"].sum()), ""))
    return figures


def _table(timings: pd.DataFrame) -> str:
    rows = [["views", "core us/hypothesis", "whole us/hypothesis", "cost ratio", "count differently"]]
    for name, mine in timings.groupby("views", sort=False):
        core, whole = mine["core_us"].mean(), mine["whole_us"].mean()
        rows.append(
            [str(name), f"{core:.1f}", f"{whole:.1f}", f"{whole / core:.2f}", str(mine["different"].sum())]
        )
    return format_columns(rows)


def _memory(opening: Opening) -> str:
    if opening.resident_mb is None:
        return "unknown"
    return f"{opening.resident_mb:,.0f} MB ({opening.before_mb:,.0f} before)"


def swarms_inside(core: SilhouetteRenderer, camera: Camera, options: ScaleOptions) -> tuple[list[Swarm], int]:
    """Returns views whose hypotheses all see ground of the core only, and how many draws were rejected.

    Raises:
        DatasetError: Hardly any do.
    """
    count = options.num_views
    while count <= options.num_views * _MAX_DRAWS_PER_VIEW:
        swarms, rejections = _swarms(core, camera, options, STEEP_DEG, count)
        kept = [i for i, swarm in enumerate(swarms) if is_inside(core.scene, camera, swarm)]
        if len(kept) >= options.num_views:
            last = kept[options.num_views - 1]
            return [swarms[i] for i in kept[: options.num_views]], rejections + last + 1 - options.num_views
        count *= 2
    raise DatasetError("Hardly any view keeps its whole footprint within the core.")


def is_inside(core: Scene, camera: Camera, swarm: Swarm) -> bool:
    """Tells whether all that a swarm's hypotheses see of the ground, z = 0, lies within a city's extent."""
    x = (np.array([0, camera.width, camera.width, 0]) - camera.cx) / camera.fx
    y = (np.array([0, 0, camera.height, camera.height]) - camera.cy) / camera.fy
    rays = np.stack([x, y, np.ones(4)], axis=1) @ swarm.rotations
    if (rays[:, :, 2] >= 0).any():
        return False
    ground = swarm.centers[:, None] - rays * swarm.centers[:, None, 2:] / rays[:, :, 2:]
    low, high = core.extent_m
    seen = np.concatenate([ground[:, :, :2].reshape(-1, 2), swarm.centers[:, :2]])
    return bool((seen > low[:2]).all() and (seen < high[:2]).all())


def _swarms(
    core: SilhouetteRenderer,
    camera: Camera,
    options: ScaleOptions,
    pitch_deg: tuple[float, float],
    count: int,
) -> tuple[list[Swarm], int]:
    sampling = ViewSampling(pitch_deg=pitch_deg, area_m=_AIM_M, seed=options.seed)
    views = sample_views(core.scene, core, camera, sampling, count, "scale", int(pitch_deg[0]))
    return [
        make_swarm(pose, i, options.hypotheses, options.seed) for i, pose in enumerate(views.poses)
    ], views.rejections


def time_views(
    name: str,
    core: SilhouetteRenderer,
    whole: SilhouetteRenderer,
    camera: Camera,
    swarms: list[Swarm],
    repeats: int,
    progress: Progress,
) -> pd.DataFrame:
    """Returns what the same views cost in both cities, timed in turns, a row each.

    Columns are ``views`` (their kind, ``name``), ``core_us`` and ``whole_us`` (microseconds per hypothesis,
    of the fastest pass), and ``different``: hypotheses whose counts differ between the two.
    """
    import pandas as pd

    rows = []
    for number, swarm in enumerate(swarms, start=1):
        mask = core.render(camera, swarm.pose)
        best = [np.inf, np.inf]
        for _ in range(repeats):
            counts = []
            for k, engine in enumerate((core, whole)):
                started = time.perf_counter()
                counts.append(engine.counts(camera, swarm.rotations, swarm.centers, mask))
                best[k] = min(best[k], (time.perf_counter() - started) / len(swarm.centers) * 1e6)
        first, second = counts
        differs = (first.intersection != second.intersection) | (first.union != second.union)
        rows.append((name, *best, int(differs.sum())))
        progress(number, len(swarms))
    return pd.DataFrame(rows, columns=["views", "core_us", "whole_us", "different"])


def _size_mb(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.glob("*")) / 1e6
