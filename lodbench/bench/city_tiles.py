"""How fast, and in how little memory, a city of thousands of tiles becomes one scene.

The tiles are a city's own buildings, over and over, side by side; every command is a process of its own, as
a user would type it.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from lodbench.bench.figures import Figure
from lodbench.citymodel.gml.writer import CityGmlWriter
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.scene_file import read_scene
from lodbench.citymodel.subset import keep_buildings
from lodbench.errors import CityModelError
from lodbench.storage import write_chunks

_GAP_M = 50.0
_TILE_BUILDINGS = 5


def measure_tiles(model: CityModel, tiles: int, folder: Path, workers: int | None) -> list[Figure]:
    """Returns the figures of so many tiles.

    Args:
        model: The city whose first buildings every tile has.
        tiles: How many.
        folder: An empty one, for tiles and scene.
        workers: Processes; None for one per core.
    """
    own = keep_buildings(model, np.arange(len(model.building_ids)) < _TILE_BUILDINGS)
    (folder / "tiles").mkdir()
    size_mb = write_tiles(own, tiles, folder / "tiles") / 1e6
    scene = folder / "city.scene"
    words = [] if workers is None else ["--workers", str(workers)]
    seconds = _run("city", "convert", str(folder / "tiles"), str(scene), *words)
    # Linux tells kilobytes: the largest of the processes, the one that joins included.
    peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3
    told = f"{tiles:,} tiles, {size_mb:,.0f} MB, {tiles * len(own.building_ids):,} buildings"
    start = time.perf_counter()
    opened, _ = read_scene(scene)
    open_seconds = time.perf_counter() - start
    return [
        Figure(f"{told}: into one scene", seconds, "s"),
        Figure("tiles", tiles / seconds, "1/s"),
        Figure("peak memory of the largest process", peak_mb, "MB"),
        Figure("triangles of the scene", len(opened.triangles), ""),
        Figure("opening the scene, all its bytes checked", open_seconds, "s"),
        Figure("lodbench city info SCENE", _run("city", "info", str(scene)), "s"),
    ]


def write_tiles(model: CityModel, tiles: int, folder: Path) -> int:
    """Writes a city so many times, side by side; returns the bytes written."""
    x, y, _ = np.ptp(model.polygons.points, axis=0) + _GAP_M
    columns = int(np.ceil(np.sqrt(tiles)))
    size = 0
    for n in range(tiles):
        shift = np.array([n % columns * x, n // columns * y, 0.0])
        ids = tuple(f"t{n}-{name}" for name in model.building_ids)
        moved = replace(model, origin=model.origin + shift, building_ids=ids, objects=None, polygon_ids=())
        moved = replace(moved, solids=None, polygons=replace(model.polygons, part=None))
        path = folder / f"{n:06d}.gml"
        write_chunks(path, CityGmlWriter(moved).chunks(), survives_power_cut=False)
        size += path.stat().st_size
    return size


def _run(*words: str) -> float:
    """Returns how long a command of ours takes, its start included, seconds."""
    start = time.perf_counter()
    done = subprocess.run(  # noqa: S603 - this interpreter, with our own module
        [sys.executable, "-m", "lodbench", *words], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise CityModelError(f"lodbench {' '.join(words)} failed: {done.stderr.strip()[-300:]}")
    return time.perf_counter() - start
