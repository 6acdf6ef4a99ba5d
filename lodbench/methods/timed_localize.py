"""Calls of methods: poses are counted by the map, time is measured, answers are checked."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, QueryFault
from lodbench.execution.guards import single_threaded_blas
from lodbench.methods.assessment import assessed
from lodbench.methods.protocol import (
    Estimate,
    FlightEstimate,
    Follower,
    Method,
    Streams,
    SupportsBatches,
    SupportsFlights,
    SupportsWeights,
)
from lodbench.plugins import blaming


@single_threaded_blas
def localize_query(method: Method, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
    """Returns a method's estimate with the poses it had drawn and the time it took.

    ``seconds`` holds the method's stages and ``other``, what it spent besides; or ``localize`` alone, where
    it tells no stages or more than there was.

    Raises:
        QueryFault: There is no estimate.
        TypeError: The method returned something else.
    """
    city_map.usage.take()
    started = time.perf_counter()
    estimate = method.localize(query, city_map, streams)
    drawn = sum(city_map.usage.take().values())
    assessed_estimate = _assessed(estimate, query, city_map, method)
    return _measured(assessed_estimate, drawn, time.perf_counter() - started)


@single_threaded_blas
def localize_queries(
    method: SupportsBatches, queries: Sequence[Query], city_map: CityMap, streams: Sequence[Streams]
) -> list[Estimate | QueryFault]:
    """Returns a method's answers to a batch, poses and time shared evenly among its queries.

    Raises:
        TypeError: The method returned another number of answers, or something else.
    """
    city_map.usage.take()
    started = time.perf_counter()
    answers = list(method.localize_batch(queries, city_map, streams))
    drawn = sum(city_map.usage.take().values()) // max(1, len(queries))
    if len(answers) != len(queries):
        raise TypeError(f"localize_batch returned {len(answers)} answers to {len(queries)} queries")
    answers = [_assessed(*pair, city_map, method) for pair in zip(answers, queries, strict=True)]
    seconds = (time.perf_counter() - started) / max(1, len(queries))
    return [found if isinstance(found, QueryFault) else _measured(found, drawn, seconds) for found in answers]


@single_threaded_blas
def localize_flight(
    method: SupportsFlights, queries: Sequence[Query], city_map: CityMap, streams: Sequence[Streams]
) -> FlightEstimate:
    """Returns a method's answer to a flight, poses drawn and time shared evenly among its photos.

    Raises:
        TypeError: The method returned another number of answers, or something else.
    """
    city_map.usage.take()
    started = time.perf_counter()
    found = method.localize_flight(queries, city_map, streams)
    drawn = sum(city_map.usage.take().values()) // max(1, len(queries))
    if not isinstance(found, FlightEstimate) or len(found.estimates) != len(queries):
        raise TypeError(f"localize_flight returned no FlightEstimate of {len(queries)} photos")
    try:
        json.dumps(found.findings, sort_keys=True)
    except (TypeError, ValueError, RecursionError) as error:
        raise TypeError(f"findings of a flight are no JSON values: {error}") from error
    answers = [_assessed(*pair, city_map, method) for pair in zip(found.estimates, queries, strict=True)]
    seconds = (time.perf_counter() - started) / max(1, len(queries))
    answers = [each if isinstance(each, QueryFault) else _measured(each, drawn, seconds) for each in answers]
    return FlightEstimate(answers, found.findings)


def localize_next(follower: Follower, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
    """Returns the estimate of a sequence's next query, with the poses it had drawn and the time it took.

    Raises:
        QueryFault: There is no estimate.
        TypeError: The method returned something else.
    """
    city_map.usage.take()
    started = time.perf_counter()
    estimate = follower.next(query, streams)
    drawn = sum(city_map.usage.take().values())
    return _measured(_assessed(estimate, query, city_map, follower), drawn, time.perf_counter() - started)


def weight_files(method: Method) -> tuple[Path, ...]:
    """Returns the files that a method reads besides its code.

    Raises:
        ConfigError: One is not there.
    """
    if not isinstance(method, SupportsWeights):
        return ()
    with blaming("methods", method.name, "name its weights"):
        files = tuple(method.weight_files())
    for file in files:
        if not file.is_file():
            raise ConfigError(f"method={method.name} has no weights {file}.", "Set `method.weights=FILE`.")
    return files


def _assessed(
    estimate: Estimate | QueryFault, query: Query, city_map: CityMap, method: object
) -> Estimate | QueryFault:
    """Returns an answer with a probability that holds; what is no answer as it is."""
    if not isinstance(estimate, Estimate):
        return estimate
    # A flight solves for its camera: what is left of it stands in the covariance already.
    is_camera_solved = isinstance(method, SupportsFlights)
    return assessed(estimate, query, city_map, getattr(method, "params", None), is_camera_solved)


def _measured(estimate: object, hypotheses: int, seconds: float) -> Estimate:
    if not isinstance(estimate, Estimate):
        raise TypeError(f"localize returned {type(estimate).__name__} instead of an Estimate")
    if len(estimate.alternative_probabilities) not in (0, len(estimate.alternatives)):
        raise TypeError("localize returned another number of alternatives than of their probabilities")
    other = seconds - sum(estimate.seconds.values())
    stages = (
        {**estimate.seconds, "other": other} if estimate.seconds and other >= 0 else {"localize": seconds}
    )
    return replace(estimate, hypotheses=hypotheses, seconds=stages)


# Rounding may make a covariance uneven, or an eigenvalue negative, by this share of the largest.
_TOLERANCE = 1e-6


def number_fault(estimate: Estimate) -> str:
    """Returns what is wrong with an estimate's times, traces and alternatives' probabilities, or ""."""
    for what, stages in (("seconds", estimate.seconds), ("trace", estimate.trace)):
        if not all(isinstance(stage, str) for stage in stages):
            return f"{what} has a stage whose name is no text"
    numbers = {
        "seconds": list(estimate.seconds.values()),
        "trace": [value for values in estimate.trace.values() for value in values],
        "alternative_probabilities": list(estimate.alternative_probabilities),
    }
    for what, values in numbers.items():
        if not all(math.isfinite(value) for value in values):
            return f"{what} holds a number that is not finite"
    return ""


def uncertainty_fault(estimate: Estimate) -> str:
    """Returns what is wrong with an estimate's probability and covariance, or ""."""
    # NaN compares as false.
    if estimate.probability is not None and not 0.0 <= estimate.probability <= 1.0:
        return f"the probability is {estimate.probability}, not within 0 and 1"
    if estimate.covariance is None:
        return ""
    matrix = np.asarray(estimate.covariance, dtype=np.float64)
    if matrix.shape != (6, 6):
        return f"the covariance is of shape {matrix.shape}, not (6, 6)"
    if not np.isfinite(matrix).all():
        return "the covariance is not finite"
    largest = float(np.abs(matrix).max())
    if np.abs(matrix - matrix.T).max() > _TOLERANCE * largest:
        return "the covariance is not symmetric"
    if np.linalg.eigvalsh(matrix).min() < -_TOLERANCE * largest:
        return "the covariance has a negative eigenvalue"
    return ""


def note_fault(estimate: Estimate) -> str:
    """Returns what is wrong with an estimate's notes, or ""."""
    # One text alone would be stored letter by letter.
    is_sound = isinstance(estimate.notes, tuple | list) and all(isinstance(n, str) for n in estimate.notes)
    return "" if is_sound else "the notes are no tuple of texts"
