"""What solving photos jointly takes beyond solving each by itself: time and memory by their number."""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter, process_time

import numpy as np

from lodbench.bench.figures import Figure, Progress, Report, no_progress
from lodbench.bench.flights import queries_of
from lodbench.citymap import CityMap
from lodbench.errors import ConfigError
from lodbench.evaluation import pose_error
from lodbench.execution.one_blas_thread import on_one_blas_thread
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
    # As runs ask methods.
    solve_jointly = on_one_blas_thread(method.solve_jointly)
    rows, walls, peaks = [], [], []
    for number, size in enumerate(sizes):
        chosen = np.linspace(0, len(every) - 1, size).round().astype(int)
        queries = [every[k] for k in chosen]
        alone = [
            Estimate(moved(truth[k], _ALONE.draw(random_stream(params.flights_seed, "alone", k))), 1.0)
            for k in chosen.tolist()
        ]
        began, cpu = perf_counter(), process_time()
        found = solve_jointly(queries, alone, CityMap(scene))
        walls.append(perf_counter() - began)
        cpu = process_time() - cpu
        errors = [
            pose_error(each.pose, truth[k]).translation_m
            for each, k in zip(found.estimates, chosen, strict=True)
            if isinstance(each, Estimate)
        ]
        row = [str(size), f"{walls[-1]:.1f}", f"{cpu:.1f}", f"{1000 * cpu / size:.0f}"]
        if traces_memory:
            tracemalloc.start()
            solve_jointly(queries, alone, CityMap(scene))
            peaks.append(tracemalloc.get_traced_memory()[1] / 2**20)
            tracemalloc.stop()
        rows.append([*row, f"{peaks[-1]:.0f}" if peaks else "-", f"{np.median(errors):.2f}"])
        progress(number + 1, len(sizes))
    head = ["photos", "seconds", "CPU s", "CPU ms per photo", "memory MiB", "median m"]
    figures = [
        Figure(f"joint solve of {size} photos", wall, "s") for size, wall in zip(sizes, walls, strict=True)
    ]
    figures += [
        Figure(f"memory, {size} photos", peak, "MiB") for size, peak in zip(sizes, peaks, strict=False)
    ]
    note = f"{dataset.city_model.name}: one flight ({params.path}), beyond what each photo by itself takes."
    if len(sizes) > 1:
        figures.append(Figure("growth of time, power of the number", _power(sizes, walls), ""))
        if peaks:
            figures.append(Figure("growth of memory, power of the number", _power(sizes, peaks), ""))
    return Report("\n".join([format_columns([head, *rows]), note]), figures)


def _power(sizes: Sequence[int], values: Sequence[float]) -> float:
    """Returns the slope in logarithms: 1 where twice the photos take twice as much."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])
