"""What `lodbench city make` takes for thousands of footprints over a square kilometre of surface model."""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import box, mapping

from experiments.command import run
from lodbench.bench import SEED, Figure, Progress, Report, no_progress
from lodbench.bench.commands import Build
from lodbench.citymodel.read import open_scene
from lodbench.citymodel.scene import floors_and_rises
from lodbench.errors import require_numbers
from lodbench.params import flag
from lodbench.reporting.aligned_text import format_columns
from lodbench.storage import random_stream
from lodbench.synthesis.surveys import write_raster

Floats = NDArray[np.float64]

# Where the square lies: metres of ETRS89 / UTM zone 32N.
_WEST, _NORTH, _CRS = 691_000.0, 5_335_000.0, "EPSG:25832"
_GROUND_M = 500.0


@dataclass(frozen=True, slots=True)
class CityMakeOptions:
    """What is made, and how large."""

    buildings: int = flag(10_000, "footprints, one in each lot of a square grid (10000)")
    side_m: float = flag(1000.0, "side of the square, metres (1000.0)")
    cell_m: float = flag(0.5, "cells of the surface model, metres (0.5)")
    seed: int = flag(0, SEED)

    def __post_init__(self) -> None:
        require_numbers(self, "", ("buildings",), 1, 1_000_000)
        require_numbers(self, "", ("side_m", "cell_m"), 0.1, 10_000.0)


def measure_city_make(options: CityMakeOptions | None = None, progress: Progress = no_progress) -> Report:
    """Returns what the command costs, and how far its heights are from those that were written."""
    options = options or CityMakeOptions()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        heights = _write_inputs(folder, options)
        progress(1, 2)
        build = Build("this build", Path(sys.executable), str(Path(__file__).parents[2]), folder)
        cost = build.run(
            ["city", "make", "--footprints", "lots.geojson", "--dsm", "dsm.tif", "made.city.json"]
        )
        made = open_scene(folder / "made.city.json")
        progress(2, 2)
    _, rises = floors_and_rises(made)
    off = np.abs(rises - heights[[int(name.removeprefix("lot-")) for name in made.building_ids]])
    share = 100.0 * float(np.mean(off <= 0.5))
    figures = [
        Figure("city make", cost.cpu_s, "s of CPU"),
        Figure("peak memory of city make", cost.peak_mib, "MiB"),
        Figure("buildings made", len(off), "", f"of {options.buildings}"),
        Figure("heights within 0.5 m", share, "%"),
    ]
    rows = [["footprints", "made", "CPU s", "clock s", "MiB", "within 0.5 m %"]]
    counts = [str(options.buildings), str(len(off)), f"{cost.cpu_s:.1f}", f"{cost.wall_s:.1f}"]
    return Report(format_columns([*rows, [*counts, f"{cost.peak_mib:.0f}", f"{share:.1f}"]]), figures)


def _write_inputs(folder: Path, options: CityMakeOptions) -> Floats:
    """Writes footprints and a surface model that has them as blocks; returns (N,) their heights."""
    generator = random_stream(options.seed, "lots")
    across = int(np.ceil(np.sqrt(options.buildings)))
    lot = options.side_m / across
    low = np.stack(np.divmod(np.arange(options.buildings), across), axis=1) * lot
    low += generator.uniform(0.1, 0.2, low.shape) * lot
    high = low + generator.uniform(0.5, 0.7, low.shape) * lot
    heights = generator.uniform(4.0, 30.0, options.buildings)
    cells = round(options.side_m / options.cell_m)
    surface = np.full((cells, cells), _GROUND_M, np.float32)
    for (west, south), (east, north), height in zip(low, high, heights, strict=True):
        columns = slice(*np.round(np.array([west, east]) / options.cell_m).astype(int))
        rows = slice(*np.round((options.side_m - np.array([north, south])) / options.cell_m).astype(int))
        surface[rows, columns] += height
    write_raster(folder / "dsm.tif", surface[None], (_WEST, _NORTH), options.cell_m, _CRS)
    features = [
        {
            "type": "Feature",
            "properties": {"id": f"lot-{n}"},
            "geometry": mapping(box(*(low[n] + corner), *(high[n] + corner))),
        }
        for corner in [np.array([_WEST, _NORTH - options.side_m])]
        for n in range(options.buildings)
    ]
    crs = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:{_CRS.replace(':', '::')}"}}
    text = json.dumps({"type": "FeatureCollection", "crs": crs, "features": features})
    (folder / "lots.geojson").write_text(text, "utf-8")
    return heights


sys.exit(run("city_make", CityMakeOptions, measure_city_make))
