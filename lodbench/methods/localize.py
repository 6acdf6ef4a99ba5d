"""Calls of methods, timed and assessed; one call from a city, a mask and a rough pose to the pose."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, LodbenchError, QueryFault
from lodbench.execution.processes import single_threaded_blas
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.methods.assessment import assessed
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.methods.protocol import (
    Estimate,
    FlightEstimate,
    Follower,
    Method,
    Streams,
    SupportsBatches,
    SupportsFlights,
    SupportsPhotosAlone,
    SupportsPrepare,
    SupportsWeights,
    Workspace,
)
from lodbench.methods.registry import make_method
from lodbench.photos.measurements import Measurements
from lodbench.plugins import blaming
from lodbench.segmentation import check_mask
from lodbench.storage import random_stream


@single_threaded_blas
def localize_query(method: Method, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
    """Returns a method's estimate with the poses it had drawn and the time it took.

    ``seconds`` holds the method's stages and ``other``, what it spent besides; or ``localize`` alone, where
    it states no stages or more than there was.

    Raises:
        QueryFault: There is no estimate.
        TypeError: The method returned something else.
    """
    return _answered(method, query, city_map, lambda: method.localize(query, city_map, streams))


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
    if len(answers) != len(queries):
        raise TypeError(f"localize_batch returned {len(answers)} answers to {len(queries)} queries")
    return _shared_out(answers, queries, city_map, method, started)


@single_threaded_blas
def localize_flight(
    method: SupportsFlights,
    queries: Sequence[Query],
    city_map: CityMap,
    streams: Sequence[Streams],
    alone: Sequence[Estimate | QueryFault] | None = None,
) -> FlightEstimate:
    """Returns a method's answer to a flight, poses drawn and time shared evenly among its photos.

    ``alone`` is what other processes found of each photo by itself: their time and poses are not counted.

    Raises:
        TypeError: The method returned another number of answers, or something else.
    """
    city_map.usage.take()
    started = time.perf_counter()
    if alone is not None and isinstance(method, SupportsPhotosAlone):
        flight = method.solve(queries, alone, city_map)
    else:
        flight = method.localize_flight(queries, city_map, streams)
    if not isinstance(flight, FlightEstimate) or len(flight.estimates) != len(queries):
        raise TypeError(f"localize_flight returned no FlightEstimate of {len(queries)} photos")
    try:
        json.dumps(flight.findings, sort_keys=True)
    except (TypeError, ValueError, RecursionError) as error:
        raise TypeError(f"findings of a flight are no JSON values: {error}") from error
    return FlightEstimate(_shared_out(flight.estimates, queries, city_map, method, started), flight.findings)


def localize_next(follower: Follower, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
    """Returns the estimate of a sequence's next query, with the poses it had drawn and the time it took.

    Raises:
        QueryFault: There is no estimate.
        TypeError: The method returned something else.
    """
    return _answered(follower, query, city_map, lambda: follower.next(query, streams))


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


def _answered(method: object, query: Query, city_map: CityMap, call: Callable[[], Estimate]) -> Estimate:
    """Returns what a call for one query gives, with the poses it had drawn and the time it took."""
    city_map.usage.take()
    started = time.perf_counter()
    estimate = call()
    drawn = sum(city_map.usage.take().values())
    assessed_estimate = _assessed(estimate, query, city_map, method)
    return _measured(assessed_estimate, drawn, time.perf_counter() - started)


def _shared_out(
    answers: Sequence[Estimate | QueryFault],
    queries: Sequence[Query],
    city_map: CityMap,
    method: object,
    started: float,
) -> list[Estimate | QueryFault]:
    """Returns answers of one call to several queries, poses drawn and time shared evenly among these."""
    drawn = sum(city_map.usage.take().values()) // max(1, len(queries))
    answers = [_assessed(*pair, city_map, method) for pair in zip(answers, queries, strict=True)]
    seconds = (time.perf_counter() - started) / max(1, len(queries))
    return [each if isinstance(each, QueryFault) else _measured(each, drawn, seconds) for each in answers]


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


def localize(
    scene: Scene,
    camera: Camera,
    prior: Pose,
    mask: NDArray[np.float32] | NDArray[np.bool_] | None = None,
    *,
    image: str | Path | None = None,
    method: str | Method | None = None,
    seed: int = 0,
    threads: int | None = None,
    lens_percent: float | None = None,
    camera_sigmas: CameraSigmas | None = None,
    measured: Measurements | None = None,
    segment: Callable[[Pose], NDArray[np.float32]] | None = None,
) -> Estimate:
    """Returns the pose of one photo, from its building mask or its pixels, and a rough pose.

    Args:
        scene: The city, from ``open_scene``.
        camera: Pinhole of the full-size photo.
        prior: Rough pose in the city's own coordinates (its CRS); so is the answer.
        mask: (H, W) probability of building in [0, 1], or bool; any size of the photo's aspect; None
            for a method that requires none.
        image: The photo's file, lens distortion undone, for a method that looks at it.
        method: How, or the name of a method with its settings as they are; LoD-Loc v2 with the paper's
            parameters by default. One that prepares does so anew.
        seed: Seed of the search.
        threads: Threads of the renderer, None for one per core; never changes the answer.
        lens_percent: Standard deviation of the camera's focal length, percent, where that is not calibrated.
        camera_sigmas: Standard deviations of all of the camera's numbers; None: as calibrated.
        measured: What was measured beside the photo: deviations of the prior, a laser's range.
        segment: Makes a mask as of ``mask``, for a method that has one made where it needs it; its argument,
            the pose to guide it, is in the scene's frame.

    Raises:
        QueryFault: The mask is not as described or holds no building, or no building is near the prior.
        LodbenchError: The scene is none, the prior is no pose, or the method is not known.
    """
    if not isinstance(scene, Scene):
        raise LodbenchError(f"{scene!r} is not a scene.", "lodbench.open_scene(FILE) makes one.")
    prior = Pose.from_matrix(prior.cam_from_world)
    photo = None if image is None else Path(image)
    probability = None if mask is None else check_mask(mask, camera)
    query = Query(
        "photo",
        "",
        camera,
        prior.shifted(-scene.origin),
        probability,
        photo,
        lens_percent=lens_percent,
        camera_sigmas=camera_sigmas,
        measured=measured,
        segment=segment,
    )
    city_map = CityMap(scene, threads=threads)
    streams = partial(random_stream, seed, "localize", "photo")
    method = make_method(method) if isinstance(method, str) else method or LodLocV2()
    with TemporaryDirectory() as folder:
        if isinstance(method, SupportsPrepare):
            method.prepare(city_map, (), Workspace(Path(folder)))
        estimate = localize_query(method, query, city_map, streams)
    return replace(
        estimate,
        pose=estimate.pose.shifted(scene.origin),
        alternatives=tuple(pose.shifted(scene.origin) for pose in estimate.alternatives),
    )
