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
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.bench.figures import Progress, Report, load_in_words, no_progress
from lodbench.bench.options import SEED, option, words
from lodbench.bench.silhouette_report import HORIZON, STEEP, report_silhouettes
from lodbench.citymodel import Scene, open_scene
from lodbench.datasets.priors import UniformPrior
from lodbench.errors import ConfigError, RenderingError
from lodbench.geometry import Camera, Pose, rotations_at_yaws
from lodbench.rendering import Scorer, make_renderer
from lodbench.storage import random_stream
from lodbench.synthesis.view_sampling import FINE_SIZE, RGB_CAMERA, ViewSampling, sample_views

Floats = NDArray[np.float64]

ENGINE = "silhouette"

# Pitch of the views, degrees from nadir, by kind.
PITCHES = {STEEP: (20.0, 60.0), HORIZON: (60.0, 75.0)}


@dataclass(frozen=True, slots=True)
class SilhouetteOptions:
    """What to measure.

    Attributes:
        sizes: Widths and heights of the masks, pixels.
        threads: Thread counts of the engine; () for one thread and one per core.
        peer_hypotheses: Hypotheses around each view for peers, the first of ours: they are slow.
        repeats: Passes over each view, peers included; the fastest counts.
    """

    num_views: int = option(20, "seeded views, pitch 20 to 60 degrees from nadir", flag="views")
    num_horizon: int = option(10, "with pitch 60 to 75, reported apart; 0 for none", flag="horizon-views")
    hypotheses: int = option(2000, "around each view")
    sizes: tuple[tuple[int, int], ...] = (FINE_SIZE, (301, 224))
    threads: tuple[int, ...] = ()
    peers: tuple[str, ...] = option(
        ("pyrender", "open3d"), "renderers to stand beside, comma-separated", parse=words
    )
    peer_hypotheses: int = 20
    repeats: int = 3
    seed: int = option(0, SEED)

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
class Swarm:
    """One view and the hypotheses around it.

    Attributes:
        pose: The view.
        rotations: (N, 3, 3) cam_from_world.
        centers: (N, 3) metres.
    """

    pose: Pose
    rotations: Floats
    centers: Floats


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
    sets = {kind: make_swarms(scene, engine, options, kind) for kind in kinds}
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
    return report_silhouettes(
        pd.DataFrame(rows),
        {kind: rejections for kind, (_, rejections) in sets.items()},
        absent,
        f"{Path(city).name}, {len(scene.triangles):,} triangles; {options.hypotheses:,} hypotheses around "
        f"each view, peers the first {options.peer_hypotheses}; best pass per view.",
        f"{os.cpu_count()} cores, {load} before the start: a busy machine slows renderers unequally.",
    )


def make_swarms(
    scene: Scene, engine: Scorer, options: SilhouetteOptions, kind: str = STEEP
) -> tuple[list[Swarm], int]:
    """Returns seeded views of a kind with their hypotheses, and how many draws of views were rejected."""
    camera = RGB_CAMERA.scaled(*FINE_SIZE)
    sampling = ViewSampling(seed=options.seed, pitch_deg=PITCHES[kind])
    count = options.num_views if kind == STEEP else options.num_horizon
    names = ["silhouettes"] if kind == STEEP else ["silhouettes", kind]
    views = sample_views(scene, engine, camera, sampling, count, *names)
    return [make_swarm(pose, i, options) for i, pose in enumerate(views.poses)], views.rejections


def make_swarm(pose: Pose, index: int, options: SilhouetteOptions) -> Swarm:
    """Returns a view with hypotheses around it, which depend on the seed and the view's number only."""
    spread = UniformPrior()
    half = np.array([spread.x_m, spread.y_m, spread.z_m, spread.yaw_deg])
    stream = random_stream(options.seed, "silhouettes", index)
    offsets = stream.uniform(-half, half, size=(options.hypotheses, 4))
    pitch_deg, roll_deg, yaw_deg = pose.euler
    rotations = rotations_at_yaws(pitch_deg, roll_deg, yaw_deg + offsets[:, 3])
    return Swarm(pose, rotations, pose.center + offsets[:, :3])


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
    """Times every contender on every view at one size; the first one makes the masks.

    Returns rows as ``report_silhouettes`` wants them.
    """
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
