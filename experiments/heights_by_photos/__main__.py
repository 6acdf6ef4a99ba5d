"""Heights of footprints by photos with known poses, beside the heights of the map they are taken from."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.command import run
from lodbench.bench import Figure, Progress, Report, no_progress
from lodbench.citymodel.scene import floors_and_rises
from lodbench.cli.bench_views import city_file, seeds
from lodbench.datasets.folder import RealFlightParams, open_real_flight
from lodbench.datasets.query import Dataset, Query
from lodbench.errors import ConfigError
from lodbench.geometry import Pose
from lodbench.harness.city import open_city
from lodbench.methods.flight.roof_sweep import footprint_heights
from lodbench.params import flag
from lodbench.reporting.aligned_text import format_columns
from lodbench.storage import random_stream
from lodbench.synthesis.camera_paths import FLIGHT_PATHS
from lodbench.synthesis.flights import FlightsParams, open_flights


def measure_heights(
    flights: dict[str, Dataset], noise_m: float, noise_deg: float, progress: Progress = no_progress
) -> Report:
    """Returns how far heights by photos are from those of the map, flight by flight.

    Args:
        flights: With true poses and photos, over blocks on the right ground; by name.
        noise_m: Standard deviation added to each photo's place along each axis.
        noise_deg: Likewise to its direction.
        progress: Called after each flight.
    """
    rows = [["flight", "photos", "buildings", "measured", "median m", "90 % m", "worst m", "rms / sigma"]]
    figures = []
    for number, (name, dataset) in enumerate(flights.items()):
        off, sigmas, in_view = _off(dataset, noise_m, noise_deg, number)
        numbers = [float(np.median(off)), float(np.percentile(off, 90)), float(off.max())]
        numbers.append(float(np.sqrt(np.mean((off / sigmas) ** 2))))
        counts = [len(dataset.entries), in_view, len(off)]
        rows.append([name, *map(str, counts), *(f"{value:.2f}" for value in numbers)])
        figures.append(Figure(f"median error of a height, {name}", numbers[0], "m"))
        figures.append(Figure(f"heights measured, {name}", len(off), "", f"of {in_view}"))
        progress(number + 1, len(flights))
    note = f"Noise of poses: {noise_m:g} m, {noise_deg:g} deg along each axis. buildings: all of the map."
    return Report("\n".join([format_columns(rows), note]), figures)


def _off(dataset: Dataset, noise_m: float, noise_deg: float, seed: int) -> tuple[Any, Any, int]:
    """Returns absolute errors, standard deviations, and the number of buildings in the map."""
    if dataset.city_model is None:
        raise ConfigError(f"{dataset.root} has no map.", "Put city.obj beside the poses.")
    scene = open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height).scene
    generator = random_stream(seed, "heights")
    queries = []
    for entry in dataset.entries:
        if entry.camera is None:
            continue
        true = dataset.truth[entry.key].shifted(-scene.origin)
        turn = Rotation.from_rotvec(generator.normal(0.0, noise_deg, 3), degrees=True).as_matrix()
        pose = Pose.from_center(turn @ true.rotation, true.center + generator.normal(0.0, noise_m, 3))
        anywhere = np.ones((1, 1), np.float32)
        queries.append(Query(entry.name, entry.split, entry.camera, pose, anywhere, entry.image))
    rises = floors_and_rises(scene)[1]
    found = footprint_heights(queries, scene)
    if not found:
        raise ConfigError(f"The photos of {dataset.root} measure no height.", "Draw more photos.")
    off = np.array([abs(height.height_m - rises[row]) for row, height in found.items()])
    return off, np.array([height.sigma_m for height in found.values()]), int((rises > 0).sum())


@dataclass(frozen=True, kw_only=True)
class HeightsOptions:
    """What is measured."""

    flight: tuple[Path, ...] = flag((), "real flights with city.obj", nargs="+", action="store")
    city: Path | None = flag(None, "city model to draw flights over")
    seeds: tuple[int, ...] = flag((0,), "of drawn flights, comma-separated (0)", type=seeds, action="store")
    photos: int = flag(16, "of each drawn flight (16)")
    path: str = flag("orbit", "how they fly (orbit)", choices=tuple(FLIGHT_PATHS))
    noise_m: float = flag(0.0, "added to places (0)")
    noise_deg: float = flag(0.0, "added to directions (0)")


def _drawn(given: HeightsOptions) -> dict[str, Dataset]:
    flights = {
        f"{given.path} {seed}": FlightsParams(
            str(city_file(given.city)), num_flights=1, num_photos=given.photos, path=given.path,
            flights_seed=seed, look="varied",
        )
        for seed in given.seeds
    }  # fmt: skip
    return {name: open_flights(params) for name, params in flights.items()}


def _measured(given: HeightsOptions, steps: Progress) -> Report:
    flights = {path.name: open_real_flight(RealFlightParams(str(path))) for path in given.flight}
    if given.city is not None:
        flights |= _drawn(given)
    if not flights:
        raise ConfigError("There is no flight.", "Give --flight DIR, or --city FILE.")
    return measure_heights(flights, given.noise_m, given.noise_deg, steps)


if __name__ == "__main__":
    sys.exit(run("heights_by_photos", HeightsOptions, _measured))
