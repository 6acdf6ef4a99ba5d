"""Tracking: drawn frames of a slow flight, from pixels to poses, with the time each takes."""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import NamedTuple

import numpy as np

from lodbench.bench import Figure, Progress, Report, load_in_words, no_progress, plain_report
from lodbench.bench.flights import queries_of
from lodbench.citymap import CityMap
from lodbench.citymodel.cache import open_cached_city
from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError
from lodbench.evaluation import pose_error
from lodbench.execution.processes import single_threaded_blas
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.angles import look_from_rotation
from lodbench.harness.city import open_city
from lodbench.harness.track import Track, TrackRequest, track
from lodbench.harness.track_frames import Footage
from lodbench.methods.flight import FlightMethod
from lodbench.methods.protocol import Estimate
from lodbench.params import flag
from lodbench.photos.pose import RoughPlace
from lodbench.reporting.aligned_text import format_columns
from lodbench.segmentation import Segmenter
from lodbench.storage import random_stream, write_bytes
from lodbench.synthesis.flights import FlightsParams, SensorErrors, moved, open_flights
from lodbench.synthesis.views import RGB_CAMERA, Photographer, SyntheticQuery, view_of

# Frames per second; metres per second and degrees per second of the flight; what its first pose is off by.
_RATE, _SPEED_M, _TURN_DEG = 10.0, 4.0, 6.0
_OFF_M, _OFF_DEG = np.array([4.0, -5.0, 6.0]), 3.0
# What a photo's own answer is off by here: half widths. Solving 500 photos one by one is another figure.
_ALONE = SensorErrors(1.0, 1.0, 0.3, 0.3)


@dataclass(frozen=True, slots=True)
class TrackingOptions:
    """What to draw."""

    frames: int = flag(60, "of each flight (60)")
    size: tuple[int, int] = (640, 480)
    look: str = flag("varied", "of the frames: plain, varied or hard (varied)")


def measure_tracking(
    city: Path,
    seeds: Sequence[int],
    segmenter: Segmenter,
    options: TrackingOptions,
    progress: Progress = no_progress,
) -> Report:
    """Returns how fast, and how far off, the frames of drawn flights are tracked.

    Args:
        city: City model.
        seeds: Each draws a flight.
        segmenter: Makes the masks.
        options: What to draw.
        progress: Called after each flight.
    """
    scene = open_cached_city(city, lod="finest").scene
    tracks, errors, sigmas_m, probabilities, lost = [], [], [], [], 0
    for number, seed in enumerate(seeds):
        drawn = _drawn(scene, seed, options)
        flight = _tracked(city, scene, drawn, segmenter, options)
        tracks.append(flight)
        for frame, query in zip(flight.frames, drawn, strict=True):
            probabilities.append(frame.probability)
            if frame.pose is None:
                lost += 1
            else:
                errors.append(pose_error(frame.pose, query.truth.shifted(scene.origin)))
                sigmas_m.append(np.nan if frame.sigmas is None else frame.sigmas[0])
        progress(number + 1, len(seeds))
    count = sum(len(flight.frames) - 1 for flight in tracks)
    # As everywhere: a frame without an answer is infinitely far off.
    metres = np.array([error.translation_m for error in errors] + [np.inf] * lost)
    degrees = np.array([error.rotation_deg for error in errors] + [180.0] * lost)

    near = int(((metres < 2.0) & (degrees < 2.0)).sum())

    def each_ms(name: str) -> float:
        return 1000.0 * sum(flight.seconds[name] for flight in tracks) / count

    sigma_m = float(np.nanmedian(sigmas_m)) if np.isfinite(sigmas_m).any() else np.inf
    figures = [
        Figure("photos per second from pixels to pose", 1000.0 / each_ms("total"), "1/s"),
        Figure("processors' time of a frame", 1000.0 * sum(flight.cpu_s for flight in tracks) / count, "ms"),
        Figure("masks, beside poses", each_ms("masks"), "ms"),
        Figure("poses", each_ms("poses"), "ms"),
        Figure("frames within 2 m and 2 deg", 100.0 * near / len(metres), "%"),
        Figure("mean probability of being within", 100.0 * float(np.mean(probabilities)), "%"),
        Figure("frames lost", lost, "", f"of {len(metres)}"),
        Figure("median translation", float(np.median(metres)), "m"),
        Figure("median rotation", float(np.median(degrees)), "deg"),
        Figure("median sigma of a place", sigma_m, "m"),
    ]  # fmt: skip
    size = f"{options.size[0]} x {options.size[1]}"
    return plain_report(f"{city.name}, {size}", figures, f"Measured under {load_in_words()}.")


def _drawn(scene: Scene, seed: int, options: TrackingOptions) -> list[SyntheticQuery]:
    """Returns the frames of a flight around the city's middle, with their photos."""
    generator = random_stream(seed, "tracking")
    middle = np.median(scene.vertices.astype(np.float64), axis=0)
    course, yaw_deg = generator.uniform(0.0, 2.0 * np.pi), generator.uniform(-180.0, 180.0)
    height_m, pitch_deg = generator.uniform(90.0, 130.0), generator.uniform(30.0, 50.0)
    ahead = np.array([np.cos(course), np.sin(course), 0.0])
    none = np.zeros((2, 2), dtype=np.bool_)
    queries = []
    for k in range(options.frames):
        time_s = k / _RATE
        angles = EulerAngles(
            pitch_deg + np.sin(0.7 * time_s), 0.4 * np.cos(time_s), yaw_deg + _TURN_DEG * time_s
        )
        target = middle + _SPEED_M * (time_s - 0.5 * options.frames / _RATE) * ahead
        pose = view_of(target, height_m + 2.0 * np.sin(time_s), angles)
        queries.append(SyntheticQuery(f"frame_{k:06d}", pose, pose, none, 1.0))
    cameras = [RGB_CAMERA.scaled(*options.size)] * len(queries)
    return Photographer(scene, options.look, seed).views(queries, cameras)


def _tracked(
    city: Path, scene: Scene, drawn: Sequence[SyntheticQuery], segmenter: Segmenter, options: TrackingOptions
) -> Track:
    first: Pose = drawn[0].truth.shifted(scene.origin)
    heading, pitch, roll = look_from_rotation(first.rotation)
    x, y, z = (float(v) for v in first.center + _OFF_M)
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "frames").mkdir()
        for query in drawn:
            assert query.photo is not None  # noqa: S101 - it was drawn
            write_bytes(folder / "frames" / query.file_name, query.photo)
        return track(
            TrackRequest(
                footage=Footage(folder / "frames", rate=_RATE),
                city=city,
                out=folder / "out",
                camera=RGB_CAMERA.scaled(*options.size),
                given=RoughPlace(heading_deg=heading + _OFF_DEG, pitch_deg=pitch, roll_deg=roll),
                center=(x, y, z),
                segmenter=segmenter,
            )
        )


def measure_joint_solves(
    flights: FlightsParams,
    sizes: Sequence[int],
    method: FlightMethod,
    *,
    traces_memory: bool,
    progress: Progress = no_progress,
) -> Report:
    """Returns seconds of joint solves, and how they grow with the number of photos.

    One flight is drawn, and every so many-th of its photos taken, so that all sizes fly the same way. Answers
    of single photos are made up: the truth, off by up to a metre.

    Args:
        flights: The city, and how the flight goes; as many photos as the largest size.
        sizes: Numbers of photos, ascending.
        method: Solves them.
        traces_memory: Whether to measure memory in a solve of its own, which takes several times as long.
        progress: Called after each size.

    Raises:
        LodbenchError: The city cannot be read, or no such flight can be drawn over it.
    """
    if sorted(set(sizes)) != list(sizes) or sizes[0] < 3:
        raise ConfigError(f"Numbers of photos ascend from 3, not {','.join(map(str, sizes))}.")
    params = replace(flights, num_flights=1, num_photos=sizes[-1])
    dataset = open_flights(params)
    if dataset.city_model is None:
        raise AssertionError("flights are drawn over a city")
    scene = open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height).scene
    every, truth = queries_of(dataset, scene, 0)
    solves = []
    for number, size in enumerate(sizes):
        chosen = np.linspace(0, len(every) - 1, size).round().astype(int).tolist()
        draws = [_ALONE.draw(random_stream(params.flights_seed, "alone", k)) for k in chosen]
        alone = [Estimate(moved(truth[k], draw), 1.0) for k, draw in zip(chosen, draws, strict=True)]
        photos = [every[k] for k in chosen], alone, [truth[k] for k in chosen]
        solves.append(_solve(method, *photos, scene, traces_memory=traces_memory))
        progress(number + 1, len(sizes))
    head = ["photos", "seconds", "CPU s", "CPU ms per photo", "memory MiB", "median m"]
    rows = [_row(size, solve) for size, solve in zip(sizes, solves, strict=True)]
    note = f"{dataset.city_model.name}: one flight ({params.path}), beyond what each photo by itself takes."
    return Report("\n".join([format_columns([head, *rows]), note]), _figures(sizes, solves))


class _Solve(NamedTuple):
    """What a joint solve took by the clock and of CPU, metres off in the median; memory if measured."""

    wall_s: float
    cpu_s: float
    error_m: float
    peak_mib: float | None


def _solve(
    method: FlightMethod,
    queries: list[Query],
    alone: list[Estimate],
    truth: list[Pose],
    scene: Scene,
    *,
    traces_memory: bool,
) -> _Solve:
    # As runs ask methods.
    solve_jointly = single_threaded_blas(method.solve_jointly)
    began, cpu = perf_counter(), process_time()
    solution = solve_jointly(queries, alone, CityMap(scene))
    wall_s, cpu_s = perf_counter() - began, process_time() - cpu
    errors = [
        pose_error(each.pose, true).translation_m
        for each, true in zip(solution.estimates, truth, strict=True)
        if isinstance(each, Estimate)
    ]
    peak_mib = None
    if traces_memory:
        tracemalloc.start()
        solve_jointly(queries, alone, CityMap(scene))
        peak_mib = tracemalloc.get_traced_memory()[1] / 2**20
        tracemalloc.stop()
    return _Solve(wall_s, cpu_s, float(np.median(errors)), peak_mib)


def _row(size: int, solve: _Solve) -> list[str]:
    memory = "-" if solve.peak_mib is None else f"{solve.peak_mib:.0f}"
    times = [f"{solve.wall_s:.1f}", f"{solve.cpu_s:.1f}", f"{1000 * solve.cpu_s / size:.0f}"]
    return [str(size), *times, memory, f"{solve.error_m:.2f}"]


def _figures(sizes: Sequence[int], solves: Sequence[_Solve]) -> list[Figure]:
    walls = [solve.wall_s for solve in solves]
    peaks = [solve.peak_mib for solve in solves if solve.peak_mib is not None]
    figures = [Figure(f"joint solve of {n} photos", wall, "s") for n, wall in zip(sizes, walls, strict=True)]
    figures += [Figure(f"memory, {n} photos", peak, "MiB") for n, peak in zip(sizes, peaks, strict=False)]
    if len(sizes) > 1:
        figures.append(Figure("growth of time, power of the number", _power(sizes, walls), ""))
        if peaks:
            figures.append(Figure("growth of memory, power of the number", _power(sizes, peaks), ""))
    return figures


def _power(sizes: Sequence[int], values: Sequence[float]) -> float:
    """Returns the slope in logarithms: 1 where twice the photos take twice as much."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])
