"""Georeferencing: reconstructions of seeded flights in frames of their own, placed again by masks."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.command import run
from lodbench.bench import Figure, Progress, Report, no_progress
from lodbench.cli.bench_views import city_file, seeds
from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.exchange.lines import write_lines
from lodbench.datasets.pose_text import FoundPose
from lodbench.datasets.query import Dataset
from lodbench.errors import LodbenchError
from lodbench.evaluation import pose_error
from lodbench.geometry import Pose
from lodbench.geometry.similarity import Similarity
from lodbench.harness.georeference import GeoreferenceRequest, georeference
from lodbench.methods.georeference import Georeference
from lodbench.params import flag
from lodbench.reporting.aligned_text import format_columns
from lodbench.storage import random_stream
from lodbench.synthesis.camera_paths import FLIGHT_PATHS
from lodbench.synthesis.flights import FlightsParams, open_flights

# A reconstruction's own units per metre; any will do.
_SCALE = 0.037


@dataclass(frozen=True, slots=True)
class Noise:
    """What a reconstruction's poses are off by, each by itself: standard deviations along each axis.

    Attributes:
        place_m: Of places, metres.
        turn_deg: Of directions, degrees.
    """

    place_m: float = 0.1
    turn_deg: float = 0.05


def measure_reconstructions(
    flights: FlightsParams, seeds: Sequence[int], noise: Noise, progress: Progress = no_progress
) -> Report:
    """Returns how far off the cameras of georeferenced reconstructions are, flight by flight.

    Args:
        flights: The city and its flights; of each seed one is drawn, or if no path is named one of each kind.
        seeds: Each draws flights of its own.
        noise: Of the reconstructions.
        progress: Called after each flight.

    Raises:
        LodbenchError: The city cannot be read, or a flight cannot be drawn.
    """
    rows = [["path", "seed", "median m", "median deg", "worst m", "off m", "sigma m", "start m"]]
    paths = list(FLIGHT_PATHS) if flights.path is None else [flights.path]
    wanted = [(path, seed) for seed in seeds for path in paths]
    # All are drawn before the first is placed: what cannot be drawn is told before the work.
    drawn = [
        open_flights(replace(flights, num_flights=1, path=path, flights_seed=seed)) for path, seed in wanted
    ]
    medians, count = [], len(wanted)
    for number, ((path, seed), dataset) in enumerate(zip(wanted, drawn, strict=True)):
        try:
            numbers = _placed(dataset, noise, seed)
            medians.append(numbers[0])
            rows.append([path, str(seed), *(f"{number:.2f}" for number in numbers)])
        except LodbenchError as fault:
            rows.append([path, str(seed), f"failed: {fault.message}", *[""] * 5])
        progress(number + 1, count)
    median = float(np.median(medians)) if medians else float("nan")
    figures = [
        Figure("median error of a camera, median of flights", median, "m"),
        Figure("flights placed", len(medians), "", f"of {count}"),
    ]
    city = Path(flights.city_model).name
    note = (
        f"{city}: {flights.num_photos} photos each, masks of IoU {flights.mask_iou:g}, reconstructions with "
        f"{noise.place_m:g} m and {noise.turn_deg:g} deg of noise along each axis. off: cameras' mean; "
        "sigma: what the answer says of it; start: median of the rough poses."
    )
    return Report("\n".join([format_columns(rows), note]), figures)


def _placed(dataset: Dataset, noise: Noise, seed: int) -> list[float]:
    """Returns the numbers of a flight's row."""
    assert dataset.city_model is not None  # noqa: S101 - it was drawn over one
    truth = {entry.name: dataset.truth[entry.key] for entry in dataset.entries}
    masks = dataset.entries[0].mask
    assert masks is not None  # noqa: S101 - they were drawn
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_reconstruction(dataset, folder, noise, seed)
        request = GeoreferenceRequest(
            model=folder / "model",
            city=dataset.city_model,
            out=folder / "out",
            method=Georeference(),
            masks=masks.parent,
            start=folder / "rough.txt",
            lod=dataset.lod,
            options=dataset.city_options,
            roof_height=dataset.roof_height,
        )
        found = georeference(request)
    errors = [pose_error(camera.pose, truth[camera.name]) for camera in found.cameras]
    off = np.mean([camera.pose.center - truth[camera.name].center for camera in found.cameras], axis=0)
    rough = [pose_error(e.prior, truth[e.name]).translation_m for e in dataset.entries if e.prior is not None]
    return [
        float(np.median([error.translation_m for error in errors])),
        float(np.median([error.rotation_deg for error in errors])),
        max(error.translation_m for error in errors),
        float(np.linalg.norm(off)),
        float(np.linalg.norm(list(found.placement["sigmas"].values())[:3])),
        float(np.median(rough)),
    ]


def write_reconstruction(dataset: Dataset, folder: Path, noise: Noise, seed: int) -> None:
    """Writes a dataset's true poses as a COLMAP model in a frame of its own, and its priors as rough poses.

    Args:
        dataset: Of flights.
        folder: Receives ``model`` and ``rough.txt``.
        noise: Of the model.
        seed: Of noise and frame.
    """
    generator = random_stream(seed, "reconstruction")
    turn = Rotation.from_quat(generator.normal(size=4)).as_matrix()
    middle = np.mean([pose.center for pose in dataset.truth.values()], axis=0)
    own = Similarity(_SCALE, turn, np.array([3.0, -2.0, 7.0]) - _SCALE * turn @ middle)
    model, rough = [], []
    for entry in dataset.entries:
        true = dataset.truth[entry.key]
        shaken = Rotation.from_rotvec(generator.normal(0.0, noise.turn_deg, 3), degrees=True).as_matrix()
        seen = Pose.from_center(shaken @ true.rotation, true.center + generator.normal(0.0, noise.place_m, 3))
        model.append(FoundPose(entry.name, "", own.pose(seen), entry.camera))
        if entry.prior is not None:
            rough.append(FoundPose(entry.name, "", entry.prior))
    write_colmap(model, folder / "model")
    write_lines(rough, folder / "rough.txt")


@dataclass(frozen=True, kw_only=True)
class ReconstructionOptions:
    """What is measured."""

    city: Path = flag(..., "city model")
    seeds: tuple[int, ...] = flag((0,), "comma-separated (0)", type=seeds, action="store")
    photos: int = flag(16, "of each flight (16)")
    mask_iou: float = flag(0.88, "of the degraded masks (0.88)")
    noise_m: float = flag(0.1, "of a reconstruction's places (0.1)")
    noise_deg: float = flag(0.05, "of its directions (0.05)")
    path: str | None = flag(None, "how they fly (each kind)", choices=tuple(FLIGHT_PATHS))
    map_lod: str | None = flag(None, "level of detail to place it in (the lowest)")
    mask_lod: str | None = flag(None, "that masks are drawn from, or finest (the map's)")


def _measured(given: ReconstructionOptions, steps: Progress) -> Report:
    flights = FlightsParams(
        str(city_file(given.city)),
        num_photos=given.photos,
        path=given.path,
        mask_iou=given.mask_iou,
        lod=given.map_lod,
        mask_lod=given.mask_lod,
    )
    return measure_reconstructions(flights, given.seeds, Noise(given.noise_m, given.noise_deg), steps)


if __name__ == "__main__":
    sys.exit(run("reconstructions", ReconstructionOptions, _measured))
