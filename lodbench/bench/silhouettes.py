"""How fast hypotheses are rendered and compared with a mask, beside other renderers in the same run.

Hypotheses lie uniformly around each seeded view, within the ranges of the published priors, and
keep the view's tilt, as a localisation method's do. Every renderer draws the same views and counts
the overlap with the same mask. Views that look to the horizon are timed apart. Renderers take turns at
every view, so that a machine that is busy for a while is busy for all of them; of several passes over
a view the fastest counts.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.bench import SEED, Figure, Progress, Report, load_in_words, no_progress, words
from lodbench.citymodel import Scene, open_scene
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError, RenderingError
from lodbench.geometry import Camera, Pose, rotations_at_yaws
from lodbench.params import flag
from lodbench.rendering import ContourFit, RegionFit, Scorer, appearance_bins, edge_bins, make_renderer
from lodbench.rendering.raster import RasterRenderer
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.figures import SERIES, draw_figure
from lodbench.storage import random_stream
from lodbench.synthesis.views import FINE_SIZE, RGB_CAMERA, ViewSampling, sample_views

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas
# For each column of dots a name, a number per view, and the report's number for all of them.
Columns = list[tuple[str, Any, float]]
ENGINE = "silhouette"
# Kinds of views, named by their pitch from nadir.
STEEP = "pitch 20 to 60"
HORIZON = "pitch 60 to 75"
# Pitch of the views, degrees from nadir, by kind.
PITCHES = {STEEP: (20.0, 60.0), HORIZON: (60.0, 75.0)}


class Timing(NamedTuple):
    """One renderer on one kind of views at one size."""

    name: str  # the renderer, and the engine's threads in words
    is_peer: bool  # whether it stands beside the engine
    size: str  # ``602x448``, the mask in pixels
    views: str  # ``STEEP`` or ``HORIZON``
    us: pd.Series[float]  # (N,) microseconds per hypothesis, rendering and IoU together, a number per view
    cores: float  # cores the process kept busy: its CPU time over wall time
    different: float  # share of pixels that differ from the engine's picture of the views themselves

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
    peers = [t for t in timings if t.is_peer]
    yield from (Figure(f"pixels unlike {t.name}, {t.where}", t.different * 100, "%") for t in peers)


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
    label = "microseconds per hypothesis, one dot per view"
    costs = _strips(timings, lambda some: [(t.name, t.us.to_numpy(), t.mean) for t in some], label)
    drawn = {"costs": draw_figure(*costs)}
    if any(t.is_peer for t in timings):
        label = "times faster than the peer, one dot per view"
        drawn["ratios"] = draw_figure(*_strips(timings, _ratios, label))
    return {f"{name}.{kind}": content for name, kinds in drawn.items() for kind, content in kinds.items()}


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
    for i, (_, values, overall) in enumerate(columns):
        colour = SERIES[i % len(SERIES)]
        places = i + 0.28 * (np.argsort(np.argsort(values)) / max(1, len(values) - 1) - 0.5)
        axis.plot(places, values, "o", color=colour, markersize=3.5, alpha=0.75, markeredgewidth=0)
        axis.hlines(overall, i - 0.42, i + 0.42, color=colour, linewidth=1.5)
        axis.annotate(f"{overall:,.0f}", (i - 0.42, overall), (0, 3), textcoords="offset points",
                      fontsize=8, color=colour)  # fmt: skip
    axis.set_xticks(range(len(columns)), [name.replace(", ", "\n") for name, _, _ in columns], fontsize=7)
    axis.set_xlim(-0.6, len(columns) - 0.4)


@dataclass(frozen=True, slots=True)
class SilhouetteOptions:
    """What to measure."""

    num_views: int = flag(
        20, "seeded views, pitch 20 to 60 degrees from nadir (20)", "--views", metavar="VIEWS"
    )
    num_horizon: int = flag(
        10, "with pitch 60 to 75, reported apart; 0 for none (10)", "--horizon-views", metavar="HORIZON_VIEWS"
    )
    hypotheses: int = flag(2000, "around each view (2000)")
    sizes: tuple[tuple[int, int], ...] = (FINE_SIZE, (301, 224))  # widths and heights of the masks, pixels
    threads: tuple[int, ...] = ()  # thread counts of the engine; () for one thread and one per core
    peers: tuple[str, ...] = flag(
        ("pyrender", "open3d"),
        "renderers to stand beside, comma-separated (pyrender,open3d)",
        type=words,
        action="store",
    )
    peer_hypotheses: int = 20  # hypotheses around each view for peers, the first of ours: they are slow
    repeats: int = 3  # passes over each view, peers included; the fastest counts
    seed: int = flag(0, SEED)

    def __post_init__(self) -> None:
        if min(self.num_views, self.hypotheses, self.peer_hypotheses, self.repeats) < 1:
            raise ConfigError("views, hypotheses, peer_hypotheses and repeats are at least 1.")
        if self.num_horizon < 0:
            raise ConfigError(f"horizon-views={self.num_horizon} is not a number of views.")
        if not self.sizes or min((side for size in self.sizes for side in size), default=0) < 1:
            raise ConfigError(f"sizes are widths and heights in pixels, not {self.sizes}.")
        if any(count < 1 for count in self.threads):
            raise ConfigError(f"threads are counts of at least 1, not {self.threads}.")

    def thread_counts(self) -> tuple[int, ...]:
        """Returns the thread counts to time the engine with, ascending."""
        return tuple(sorted(set(self.threads or (1, os.cpu_count() or 1))))


@dataclass(frozen=True, slots=True, eq=False)
class Contender:
    """A renderer to time."""

    scorer: Scorer
    threads: int | None
    count: int

    @property
    def words(self) -> str:
        """Returns the renderer and its threads in words."""
        if self.threads is None:
            return self.scorer.name
        return f"{self.scorer.name}, {self.threads} thread{'s' if self.threads > 1 else ''}"


def measure_silhouettes(
    city: Path, options: SilhouetteOptions | None = None, progress: Progress = no_progress
) -> Report:
    """Returns the time per hypothesis, rendering and IoU together, of the engine and its peers.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    import pandas as pd

    options = options or SilhouetteOptions()
    load = load_in_words()
    scene = open_scene(city)
    engine = make_renderer(ENGINE, scene, 1)
    kinds = PITCHES if options.num_horizon else (STEEP,)
    counts = {STEEP: options.num_views, HORIZON: options.num_horizon}
    sets = {
        kind: make_swarms(scene, engine, counts[kind], options.hypotheses, options.seed, kind)
        for kind in kinds
    }
    contenders, absent = _contenders(scene, options)
    jobs = [
        (kind, size) for kind in sets for size in options.sizes if kind == STEEP or size == options.sizes[0]
    ]
    total, done = sum(len(sets[kind][0]) for kind, _ in jobs), count(1)
    rows: list[dict[str, Any]] = []
    for kind, size in jobs:
        camera = RGB_CAMERA.scaled(*size)
        rows += _time_views(
            kind, contenders, sets[kind][0], camera, options.repeats, lambda: progress(next(done), total)
        )
    report = report_silhouettes(
        pd.DataFrame(rows),
        {kind: rejections for kind, (_, rejections) in sets.items()},
        absent,
        f"{Path(city).name}, {len(scene.triangles):,} triangles; {options.hypotheses:,} hypotheses around "
        f"each view, peers the first {options.peer_hypotheses}; best pass per view.",
        f"{os.cpu_count()} cores, {load} before the start: a busy machine slows renderers unequally.",
    )
    statistics = _time_statistics(scene, engine, sets[STEEP][0], options)
    lines = [f"{each.figure}: {each.value:.1f} us/hypothesis." for each in statistics]
    return replace(report, text="\n".join([report.text, *lines]), figures=[*report.figures, *statistics])


def _time_statistics(
    scene: Scene, engine: Scorer, swarms: list[Swarm], options: SilhouetteOptions
) -> list[Figure]:
    """Returns what `region` scores a hypothesis by, rendering included, one thread, at the last size.

    Of photos that the raster draws, in colour.
    """
    size, raster = options.sizes[-1], RasterRenderer(scene, 1)
    camera = RGB_CAMERA.scaled(*size)
    taken: dict[str, list[float]] = {}
    for swarm in swarms:
        photo = raster.draw(camera, swarm.pose).colour[..., ::-1]
        for name, fit in (
            ("colours on either side", RegionFit(*appearance_bins(photo, size))),
            ("edges along the outline", ContourFit(*edge_bins(photo, size, 1.0))),
        ):
            passes = []
            for _ in range(options.repeats):
                start_s = time.perf_counter()
                engine.fit(camera, swarm.rotations, swarm.centers, fit)
                passes.append(time.perf_counter() - start_s)
            taken.setdefault(name, []).append(min(passes) / len(swarm.centers) * 1e6)
    where = f"{size[0]}x{size[1]}, {engine.name}, 1 thread"
    return [Figure(f"render and {name}, {where}", float(np.mean(us)), "us") for name, us in taken.items()]


def _contenders(scene: Scene, options: SilhouetteOptions) -> tuple[list[Contender], dict[str, str]]:
    """Returns the engine at each thread count and the peers there are; and why others are absent."""
    contenders = [
        Contender(make_renderer(ENGINE, scene, threads), threads, options.hypotheses)
        for threads in options.thread_counts()
    ]
    absent: dict[str, str] = {}
    for name in options.peers:
        try:
            peer = make_renderer(name, scene)
            # A missing driver shows with the first picture, not before.
            peer.render(RGB_CAMERA.scaled(*options.sizes[0]), Pose(np.eye(3), np.zeros(3)))
        except RenderingError as error:
            absent[name] = error.message
        else:
            contenders.append(Contender(peer, None, options.peer_hypotheses))
    return contenders, absent


def _time_views(
    kind: str,
    contenders: list[Contender],
    swarms: list[Swarm],
    camera: Camera,
    repeats: int,
    step: Callable[[], None],
) -> list[dict[str, Any]]:
    """Returns rows of every contender on every view at one size; the first one makes the masks."""
    rows = []
    for swarm in swarms:
        mask = contenders[0].scorer.render(camera, swarm.pose)
        for contender in contenders:
            different = float((contender.scorer.render(camera, swarm.pose) != mask).mean())
            taken, cores = _best_pass(contender, camera, swarm, mask, repeats)
            rows.append(
                {
                    "name": contender.words,
                    "is_peer": contender.threads is None,
                    "size": f"{camera.width}x{camera.height}",
                    "views": kind,
                    "us": taken,
                    "cores": cores,
                    "different": different,
                }
            )
        step()
    return rows


def _best_pass(
    contender: Contender, camera: Camera, swarm: Swarm, mask: NDArray[np.bool_], repeats: int
) -> tuple[float, float]:
    """Returns microseconds per hypothesis of the fastest pass over a view, and the cores it kept busy."""
    rotations, centers = swarm.rotations[: contender.count], swarm.centers[: contender.count]
    passes = []
    for _ in range(repeats):
        # The whole process: a library's own threads count too.
        started, worked = time.perf_counter(), time.process_time()
        contender.scorer.counts(camera, rotations, centers, mask)
        seconds = time.perf_counter() - started
        passes.append((seconds / len(centers) * 1e6, (time.process_time() - worked) / seconds))
    return min(passes)


@dataclass(frozen=True, slots=True, eq=False)
class Swarm:
    """One view and the hypotheses around it."""

    pose: Pose  # the view
    rotations: NDArray[np.float64]  # (N, 3, 3) cam_from_world
    centers: NDArray[np.float64]  # (N, 3) metres


def make_swarms(
    scene: Scene, engine: Scorer, count: int, hypotheses: int, seed: int, kind: str = STEEP
) -> tuple[list[Swarm], int]:
    """Returns seeded views of a kind with their hypotheses, and how many draws of views were rejected."""
    camera = RGB_CAMERA.scaled(*FINE_SIZE)
    sampling = ViewSampling(seed=seed, pitch_deg=PITCHES[kind])
    names = ["silhouettes"] if kind == STEEP else ["silhouettes", kind]
    views = sample_views(scene, engine, camera, sampling, count, *names)
    return [make_swarm(pose, i, hypotheses, seed) for i, pose in enumerate(views.poses)], views.rejections


def make_swarm(pose: Pose, index: int, hypotheses: int, seed: int) -> Swarm:
    """Returns a view with hypotheses around it, which depend on the seed and the view's number only."""
    spread = UniformPrior()
    half = np.array([spread.x_m, spread.y_m, spread.z_m, spread.yaw_deg])
    stream = random_stream(seed, "silhouettes", index)
    offsets = stream.uniform(-half, half, size=(hypotheses, 4))
    pitch_deg, roll_deg, yaw_deg = pose.euler
    rotations = rotations_at_yaws(pitch_deg, roll_deg, yaw_deg + offsets[:, 3])
    return Swarm(pose, rotations, pose.center + offsets[:, :3])
