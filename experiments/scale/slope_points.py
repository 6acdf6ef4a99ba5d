"""The points of the slopes, each in a process of its own: CPU seconds, and the memory it held at most.

Peaks are of whole processes, Python and its libraries included, which hold some 150 MB before any work.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from experiments.scale.grown_city import TILE_BUILDINGS, open_grown_city
from experiments.scale.measure import ScaleOptions, swarms_inside
from lodbench.bench.city import write_tiles
from lodbench.bench.silhouettes import Swarm
from lodbench.citymodel.derive import keep_buildings
from lodbench.citymodel.mesh.writer import obj_text
from lodbench.citymodel.read import read_city_model
from lodbench.citymodel.scene_file import read_scene
from lodbench.execution import Ledger
from lodbench.execution.executor import PROCESS, SERIAL, ExecutorParams, spread
from lodbench.geometry import Camera
from lodbench.harness.city import compile_tiles
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.storage import write_text
from lodbench.synthesis.views import FINE_SIZE, RGB_CAMERA

# Hypotheses of an item that workers share; buildings of a tile.
_ITEM, _TILE = 500, 500


@dataclass(frozen=True, slots=True)
class Cost:
    """What a point took.

    Attributes:
        cpu_s: CPU seconds of the work.
        peak_mb: Most memory that its processes held, megabytes; NaN where the system does not tell.
    """

    cpu_s: float
    peak_mb: float


@dataclass(frozen=True, slots=True)
class Reach:
    """How far each axis goes; see ``SlopeOptions``."""

    hypotheses: int
    buildings: int
    tiled: int
    queries: int
    workers: int
    seed: int


# CPU seconds, and the peak of processes besides the one that tells.
Work = Callable[[], tuple[float, float]]


def points_within(reach: Reach) -> Iterator[tuple[str, int, Callable[[], Cost]]]:
    """Yields axis, size and what returns the cost of every point.

    Raises:
        DatasetError: Hardly any view keeps its footprint within the city.
        OSError: The cache cannot be written.
    """
    small_city = open_grown_city(TILE_BUILDINGS, reach.seed)
    engine = SilhouetteRenderer(read_scene(small_city)[0], 1)
    camera = RGB_CAMERA.scaled(*FINE_SIZE)
    swarm = swarms_inside(engine, camera, ScaleOptions(num_views=1, hypotheses=100, seed=reach.seed))[0][0]
    for count in _steps(100, reach.hypotheses, 10):
        yield "hypotheses", count, partial(_apart, partial(_score, small_city, camera, swarm, count))
    for width in (150, 300, 600, 1200):
        small = camera.scaled(width, round(width * camera.height / camera.width))
        yield "image width, px", width, partial(_apart, partial(_score, small_city, small, swarm, 1000))
    for buildings in _steps(TILE_BUILDINGS, reach.buildings, 10):
        yield "buildings, opened", buildings, partial(_opened, buildings, reach.seed)
    for buildings in _steps(TILE_BUILDINGS, reach.buildings, 10):
        folder = open_grown_city(buildings, reach.seed)
        yield (
            "buildings, 1000 hypotheses",
            buildings,
            partial(_apart, partial(_score, folder, camera, swarm, 1000)),
        )
    for buildings in _steps(1000, reach.tiled, 10):
        yield "buildings of CityGML tiles, compiled", buildings, partial(_compiled, buildings, reach.seed)
    for queries in _steps(10, reach.queries, 10):
        yield "queries stored and read", queries, partial(_apart, partial(_store, queries))
    for workers in _steps(1, reach.workers, 2):
        yield (
            "workers, 16,000 hypotheses",
            workers,
            partial(_apart, partial(_share, workers, small_city, camera, swarm)),
        )


def _steps(first: int, last: int, factor: int) -> list[int]:
    sizes = [first]
    while sizes[-1] * factor <= last:
        sizes.append(sizes[-1] * factor)
    return sizes


def _apart(work: Work) -> Cost:
    """Returns what work costs in a fresh process."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_cost, work).result()


def _cost(work: Work) -> Cost:
    cpu_s, others_mb = work()
    return Cost(cpu_s, peak_mb() + others_mb)


def peak_mb() -> float:
    """Returns the most memory that this process has held, megabytes; NaN where the system does not tell."""
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text()) if status.is_file() else None
    return int(found[1]) * 1024 / 1e6 if found else float("nan")


def _score(folder: Path, camera: Camera, swarm: Swarm, count: int) -> tuple[float, float]:
    """Scores so many hypotheses, those around a pose again and again."""
    return _scored(SilhouetteRenderer(read_scene(folder)[0], 1), camera, swarm, count), 0.0


def _scored(engine: SilhouetteRenderer, camera: Camera, swarm: Swarm, count: int) -> float:
    mask = engine.render(camera, swarm.pose)
    turns = np.arange(count) % len(swarm.centers)
    rotations, centers = swarm.rotations[turns], swarm.centers[turns]
    engine.counts(camera, rotations[:1], centers[:1], mask)
    started = time.process_time()
    engine.counts(camera, rotations, centers, mask)
    return time.process_time() - started


def _opened(buildings: int, seed: int) -> Cost:
    folder = open_grown_city(buildings, seed)
    SilhouetteRenderer(read_scene(folder)[0], 1)  # laid out and stored the first time
    return _apart(partial(_open, folder))


def _open(folder: Path) -> tuple[float, float]:
    started = time.process_time()
    SilhouetteRenderer(read_scene(folder)[0], 1)
    return time.process_time() - started, 0.0


def _compiled(buildings: int, seed: int) -> Cost:
    """Compiles tiles of the grown city's first buildings, written anew, by one process."""
    with tempfile.TemporaryDirectory() as folder:
        city = Path(folder) / "city.obj"
        scene, _ = read_scene(open_grown_city(TILE_BUILDINGS, seed))
        write_text(city, obj_text(scene), survives_power_cut=False)
        model = read_city_model(city)
        tiles = Path(folder) / "tiles"
        tiles.mkdir()
        first = np.arange(len(model.building_ids)) < _TILE
        write_tiles(keep_buildings(model, first), buildings // _TILE, tiles)
        return _apart(partial(_compile, tiles, Path(folder) / "city.scene"))


def _compile(tiles: Path, scene: Path) -> tuple[float, float]:
    started = time.process_time()
    compile_tiles(tiles, scene, executor=ExecutorParams(SERIAL))
    return time.process_time() - started, 0.0


def _store(queries: int) -> tuple[float, float]:
    """Stores answers one by one, as a run does, and reads them back."""
    answer = {"pose": [0.125] * 7, "failure": "", "score": 0.5, "hypotheses": 500, "seconds": {"coarse": 0.1}}
    with tempfile.TemporaryDirectory() as folder:
        started = time.process_time()
        ledger = Ledger(Path(folder) / "predictions.jsonl")
        for number in range(queries):
            ledger.record(f"split/{number}.png", answer)
        Ledger(Path(folder) / "predictions.jsonl")
        return time.process_time() - started, 0.0


# What a worker has opened.
_here: list[tuple[SilhouetteRenderer, Camera, Swarm]] = []


def _share(workers: int, folder: Path, camera: Camera, swarm: Swarm) -> tuple[float, float]:
    """Shares work over processes; all of them count, opening included: what workers cost besides."""
    executor = ExecutorParams(PROCESS, workers=workers)
    started = time.process_time()
    used: dict[int, tuple[float, float]] = {}
    for worker, *told in spread(executor, _item, range(16_000 // _ITEM), _begin, (folder, camera, swarm)):
        used[worker] = max(used.get(worker, (0.0, 0.0)), (told[0], told[1]))
    used[os.getpid()] = (time.process_time() - started, 0.0)
    return sum(cpu_s for cpu_s, _ in used.values()), sum(mb for _, mb in used.values())


def _begin(folder: Path, camera: Camera, swarm: Swarm) -> None:
    _here[:] = [(SilhouetteRenderer(read_scene(folder)[0], 1), camera, swarm)]


def _item(_: int) -> tuple[int, float, float]:
    """Returns which process scored an item, the CPU seconds it has used since it started, and its peak."""
    engine, camera, swarm = _here[0]
    _scored(engine, camera, swarm, _ITEM)
    return os.getpid(), time.process_time(), peak_mb()
