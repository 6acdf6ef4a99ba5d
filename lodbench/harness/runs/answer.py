"""One query given to a method: the estimate, or why there is none, as it is stored."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Entry, Query
from lodbench.errors import STOPPED, ConfigError, InputChanged, LodbenchError, QueryFault, WorkersGone
from lodbench.evaluation.predictions import Prediction, encoded_mask
from lodbench.execution.guards import staying_here
from lodbench.geometry import Pose
from lodbench.harness.runs.prepare import Preparation
from lodbench.harness.tracebacks import keep_traceback, words_of
from lodbench.methods import Estimate, Method
from lodbench.methods.localize import (
    localize_flight,
    localize_queries,
    localize_query,
    note_fault,
    number_fault,
    uncertainty_fault,
)
from lodbench.methods.protocol import Streams, SupportsBatches, SupportsFlights
from lodbench.segmentation import binary_mask, no_wider
from lodbench.storage import make_folder, write_text
from lodbench.storage.disk import writable

# What flights say besides poses, one file each.
FLIGHTS_FOLDER = "flights"
# Masks are stored, and compared with the truth, at most at this width, pixels: the paper's fine size.
_MASK_WIDTH = 602
# Those of a flight are held at most at this width, pixels: of 500 drone's photos the whole have 40 GB.
_HELD_WIDTH = 2 * _MASK_WIDTH
# No query is to blame for these. A plug-in's sys.exit is a fault like others: it would end a run silently.
_ENDS_RUN = (ConfigError, InputChanged, WorkersGone, *STOPPED)


@dataclass(slots=True)
class Asked:
    """A query on its way to a prediction.

    Attributes:
        entry: As the dataset stores it.
        streams: Its random numbers.
        query: As the method sees it, once it is made.
        prepare_s: How long that took, seconds.
        estimate: The method's, if there is one.
        failure: Why there is none.
    """

    entry: Entry
    streams: Streams
    query: Query | None = None
    prepare_s: float = 0.0
    estimate: Estimate | None = None
    failure: str = ""

    def prediction(self, preparation: Preparation, folder: Path) -> Prediction:
        """Returns what is stored: the estimate, or why there is none; an odd estimate is a fault too."""
        mask = "" if self.query is None else _stored_mask(self.query)
        if self.estimate is not None:
            with _failing(self, folder):
                return _stored_estimate(self.estimate, self.prepare_s, mask, preparation)
        return Prediction(None, writable(self.failure), hypotheses=0, mask_png=mask)


def _stored_estimate(
    found: Estimate, prepare_s: float, mask_png: str, preparation: Preparation
) -> Prediction:
    """Returns an estimate as it is stored."""
    fault = number_fault(found) or uncertainty_fault(found) or note_fault(found)
    if fault:
        raise ValueError(fault)
    return Prediction(
        pose=Pose.from_matrix(preparation.in_dataset_frame(found.pose).cam_from_world),
        score=float(found.score) if math.isfinite(found.score) else None,
        hypotheses=int(found.hypotheses),
        seconds={"prepare": prepare_s, **{stage: float(spent) for stage, spent in found.seconds.items()}},
        trace={stage: tuple(map(float, scores)) for stage, scores in found.trace.items()},
        probability=None if found.probability is None else float(found.probability),
        covariance=_upper_triangle(found.covariance),
        alternatives=tuple(
            Pose.from_matrix(preparation.in_dataset_frame(pose).cam_from_world) for pose in found.alternatives
        ),
        alternative_probabilities=tuple(map(float, found.alternative_probabilities)),
        notes=tuple(map(writable, found.notes)),
        mask_png=mask_png,
    )


@staying_here()
def answer(
    method: Method, preparation: Preparation, city_map: CityMap, waiting: Sequence[Asked], folder: Path
) -> None:
    """Fills in estimates, or why there are none."""
    for each in waiting:
        with _failing(each, folder):
            started = time.perf_counter()
            query = preparation.query(each.entry)
            each.query = _with_small_mask(query) if isinstance(method, SupportsFlights) else query
            each.prepare_s = time.perf_counter() - started
    ready = [(each, each.query) for each in waiting if each.query is not None]
    if isinstance(method, SupportsFlights) and ready:
        _answer_flight(method, city_map, ready, folder)
        return
    if isinstance(method, SupportsBatches) and len(ready) > 1:
        try:
            answers = localize_queries(
                method, [query for _, query in ready], city_map, [each.streams for each, _ in ready]
            )
        except _ENDS_RUN:
            raise
        except BaseException as error:  # one by one it shows which query it is
            keep_traceback(folder, f"batch {ready[0][0].entry.key}", error)
        else:
            for (each, _), answer in zip(ready, answers, strict=True):
                with _failing(each, folder):
                    if isinstance(answer, QueryFault):
                        raise answer
                    each.estimate = answer
            return
    for each, query in ready:
        with _failing(each, folder):
            each.estimate = localize_query(method, query, city_map, each.streams)


def _with_small_mask(query: Query) -> Query:
    """Returns a query whose mask is no larger than methods need: those of a whole flight are held."""
    if query.building_probability is None:
        return query
    small = no_wider(query.building_probability, _HELD_WIDTH, query.camera)
    return replace(query, building_probability=small)


def _answer_flight(
    method: SupportsFlights, city_map: CityMap, ready: Sequence[tuple[Asked, Query]], folder: Path
) -> None:
    """Fills in the estimates of a flight's photos; what it says besides goes to the run's folder."""
    first = ready[0][0].entry
    try:
        found = localize_flight(
            method, [query for _, query in ready], city_map, [each.streams for each, _ in ready]
        )
    except _ENDS_RUN:
        raise
    except BaseException as error:
        keep_traceback(folder, first.key, error)
        for each, _ in ready:
            each.failure = words_of(error)
        return
    for (each, _), answer in zip(ready, found.estimates, strict=True):
        with _failing(each, folder):
            if isinstance(answer, QueryFault):
                raise answer
            each.estimate = answer
    if found.findings:
        make_folder(folder / FLIGHTS_FOLDER)
        reported = json.dumps(found.findings, indent=1, sort_keys=True)
        write_text(folder / FLIGHTS_FOLDER / f"{flight_name(first)}.json", reported + "\n")


def flight_name(entry: Entry) -> str:
    """Returns what the files of a query's flight are called, whatever its dataset calls the sequence."""
    name = f"{entry.split}-{entry.sequence or 'all'}"
    return name.replace("%", "%25").replace("/", "%2F").replace("\\", "%5C")


@contextmanager
def _failing(each: Asked, folder: Path) -> Iterator[None]:
    """Turns what is raised into a query's failure, but for what ends a run; keeps a plug-in's traceback."""
    try:
        yield
    except _ENDS_RUN:
        raise
    except LodbenchError as fault:
        each.failure = fault.message if isinstance(fault, QueryFault) else fault.message.rstrip(".")
    except BaseException as error:
        keep_traceback(folder, each.entry.key, error)
        each.failure = words_of(error)


def _stored_mask(query: Query) -> str:
    """Returns a query's mask at its own size, or at 602 pixels' width if it is larger; "" for none."""
    if query.building_probability is None:
        return ""
    height, width = query.building_probability.shape
    if width > _MASK_WIDTH:
        height, width = max(1, round(_MASK_WIDTH * height / width)), _MASK_WIDTH
    return encoded_mask(binary_mask(query.building_probability, width, height))


def _upper_triangle(covariance: NDArray[np.float64] | None) -> tuple[float, ...]:
    """Returns the 21 numbers of a (6, 6) covariance on and above its diagonal, row by row; () for none."""
    return () if covariance is None else tuple(float(v) for v in np.asarray(covariance)[np.triu_indices(6)])
