"""What solving photos jointly takes beyond solving each by itself: time and memory by their number."""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter, process_time
from typing import NamedTuple

import numpy as np

from lodbench.bench.figures import Figure, Progress, Report, no_progress
from lodbench.bench.flights import queries_of
from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError
from lodbench.evaluation import pose_error
from lodbench.execution.single_threaded_blas import single_threaded_blas
from lodbench.geometry import Pose
from lodbench.harness.city import open_city
from lodbench.methods.flight import FlightMethod
from lodbench.methods.protocol import Estimate
from lodbench.reporting.aligned_text import format_columns
from lodbench.storage import random_stream
from lodbench.synthesis.flights.dataset import FlightsParams, open_flights
from lodbench.synthesis.flights.errors import SensorErrors, moved

# What a photo's own answer is off by here: half widths. Solving 500 photos one by one is another figure.
_ALONE = SensorErrors(1.0, 1.0, 0.3, 0.3)


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
    found = solve_jointly(queries, alone, CityMap(scene))
    wall_s, cpu_s = perf_counter() - began, process_time() - cpu
    errors = [
        pose_error(each.pose, true).translation_m
        for each, true in zip(found.estimates, truth, strict=True)
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
