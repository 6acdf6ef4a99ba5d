"""The first half of a run: a method's answer to every query, stored as it comes; the truth is elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.texture_files import open_textured_map
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset, Entry, Query
from lodbench.errors import ConfigError, DatasetError, LodbenchError, QueryFault
from lodbench.evaluation.predictions import Prediction, encoded_mask
from lodbench.execution import Ledger, Progress
from lodbench.execution.executor import SERIAL, ExecutorParams, spread
from lodbench.geometry import Camera, Pose
from lodbench.harness.city import open_city, scene_digest
from lodbench.harness.runs.method_inputs import keep_traceback, prepare_method
from lodbench.harness.runs.prepare import Preparation
from lodbench.methods import Estimate, Method
from lodbench.methods.asking import localize_queries, localize_query
from lodbench.methods.protocol import Streams, SupportsBatches
from lodbench.segmentation import Segmenter, binary_mask
from lodbench.storage import random_stream

PREDICTIONS_FILE = "predictions.jsonl"
# Masks are stored, and compared with the truth, at most at this width, pixels: the paper's fine size.
_MASK_WIDTH = 602


def open_predictions(folder: Path, read_only: bool = False) -> Ledger:
    """Returns the stored predictions of a run folder, as JSON objects by ``Entry.key``."""
    path, older = folder / PREDICTIONS_FILE, folder / "ledger.jsonl"
    return Ledger(older if older.is_file() and not path.is_file() else path, read_only)


@dataclass(frozen=True, slots=True, eq=False)
class Work:
    """What a process needs to answer queries: the city is opened there, from the cache.

    Attributes:
        method: What finds poses.
        dataset: Where the queries come from.
        segmenter: Makes the masks.
        renderer: Name of the renderer.
        threads: Threads of the renderer; None for one per core.
        tilt: As for ``Preparation``.
        needs: As for ``Preparation``.
        seed: Of the random streams.
        params: The method's parameters, as JSON values.
        inputs: Digests of the run's inputs.
        folder: The run's.
        stream_names: As for ``RunSettings``.
    """

    method: Method
    dataset: Dataset
    segmenter: Segmenter
    renderer: str
    threads: int | None
    tilt: str
    needs: frozenset[Input]
    seed: int
    params: object
    inputs: dict[str, str]
    folder: Path
    stream_names: Callable[[Entry], tuple[str, ...]] | None = None

    def streams_of(self, entry: Entry) -> Streams:
        """Returns the random numbers of a query: never by worker or order."""
        names = (self.dataset.name, entry.key) if self.stream_names is None else self.stream_names(entry)
        return partial(random_stream, self.seed, *names)

    def answers(
        self, preparation: Preparation, city_map: CityMap, entries: Sequence[Entry]
    ) -> list[tuple[str, dict[str, Any]]]:
        """Returns the keys of queries and the predictions of their poses as JSON values."""
        asked = [_Asked(entry, self.streams_of(entry)) for entry in entries]
        _answer(self.method, preparation, city_map, asked, self.folder)
        return [(each.entry.key, each.prediction(preparation, self.folder).to_json()) for each in asked]


def predict(
    work: Work,
    preparation: Preparation,
    city_map: CityMap,
    entries: Sequence[Entry],
    executor: ExecutorParams,
    retries_failed: bool = False,
) -> dict[str, Prediction]:
    """Returns the predictions of some queries by key; those that are stored already are not made again.

    Each is stored in the run's folder as it comes.

    Args:
        work: What is done with each query; its method is prepared where the executor is serial.
        preparation: Makes the queries in this process.
        city_map: What they are found on in this process.
        entries: The queries.
        executor: Where the work is done; it changes no prediction.
        retries_failed: Whether queries whose stored prediction is a failure are asked again.

    Raises:
        ConfigError: A setting of the method or the segmenter is wrong, which only a query could tell.
        LodbenchError: Workers keep dying, or the scheduler is not there.
    """
    stored = open_predictions(work.folder)
    waiting = [e for e in entries if e.key not in stored or (retries_failed and stored[e.key]["failure"])]
    size = work.method.batch_size if isinstance(work.method, SupportsBatches) else 1
    batches = [waiting[start : start + size] for start in range(0, len(waiting), size)]
    with Progress(f"{work.method.name} on {work.dataset.name}", len(entries)) as progress:
        progress.advance(len(entries) - len(waiting))
        answers: Iterator[list[tuple[str, dict[str, Any]]]]
        if executor.name == SERIAL:
            _warm_up(city_map)
            answers = (work.answers(preparation, city_map, batch) for batch in batches)
        else:
            answers = spread(executor, _answer_here, batches, _open_here, (work,))
        for answered in answers:
            for key, answer in answered:
                stored.record(key, answer)
                progress.advance()
    return {entry.key: Prediction.from_json(stored[entry.key]) for entry in entries}


# What this worker process has opened; set once, before its first query.
_here: list[tuple[Work, Preparation, CityMap]] = []


def _open_here(work: Work) -> None:
    dataset = work.dataset
    if dataset.city_model is None:
        raise ConfigError("There is no city model to localise against.", dataset.city_hint)
    scene = open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height).scene
    textured = None
    if dataset.textured_map is not None:
        textured = open_textured_map(dataset.textured_map, scene, options=dataset.city_options)
    found = {"scene": scene_digest(scene), "textured_map": "" if textured is None else textured.digest()}
    if any(work.inputs.get(name, "") != digest for name, digest in found.items()):
        reason = f"{dataset.city_model} is another city for a worker, or has changed since the start."
        raise DatasetError(reason, "Let all workers see the same files.")
    city_map = CityMap(scene, work.renderer, work.threads, textured)
    preparation = Preparation(dataset, scene, work.segmenter, work.tilt, work.needs, city_map)
    # It finds prepared what the run's own process prepared.
    prepare_method(work.method, work.params, work.inputs, city_map, dataset.references, work.folder)
    _warm_up(city_map)
    _here[:] = [(work, preparation, city_map)]


def _answer_here(entries: Sequence[Entry]) -> list[tuple[str, dict[str, Any]]]:
    work, preparation, city_map = _here[0]
    return work.answers(preparation, city_map, entries)


def _warm_up(city_map: CityMap) -> None:
    """Lets the renderer compile, or load what it compiled, before the first query's clock runs."""
    camera = Camera(8, 8, 8.0, 8.0, 4.0, 4.0)
    city_map.counts(camera, np.eye(3)[None], np.zeros((1, 3)), np.zeros((8, 8), dtype=np.bool_))


@dataclass(slots=True)
class _Asked:
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
        return Prediction(None, self.failure, hypotheses=0, mask_png=mask)


def _stored_estimate(
    found: Estimate, prepare_s: float, mask_png: str, preparation: Preparation
) -> Prediction:
    return Prediction(
        pose=Pose.from_matrix(preparation.in_dataset_frame(found.pose).cam_from_world),
        score=float(found.score) if math.isfinite(found.score) else None,
        hypotheses=int(found.hypotheses),
        seconds={"prepare": prepare_s, **found.seconds},
        trace={stage: tuple(map(float, scores)) for stage, scores in found.trace.items()},
        probability=None if found.probability is None else float(found.probability),
        covariance=_upper_triangle(found.covariance),
        mask_png=mask_png,
    )


def _answer(
    method: Method, preparation: Preparation, city_map: CityMap, asked: Sequence[_Asked], folder: Path
) -> None:
    """Fills in estimates, or why there are none."""
    for each in asked:
        with _failing(each, folder):
            started = time.perf_counter()
            each.query = preparation.query(each.entry)
            each.prepare_s = time.perf_counter() - started
    ready = [(each, each.query) for each in asked if each.query is not None]
    if isinstance(method, SupportsBatches) and len(ready) > 1:
        try:
            answers = localize_queries(
                method, [query for _, query in ready], city_map, [each.streams for each, _ in ready]
            )
        except ConfigError:
            raise
        except Exception as error:  # one by one it shows which query it is
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


@contextmanager
def _failing(each: _Asked, folder: Path) -> Iterator[None]:
    """Turns what is raised into a query's failure, but for wrong settings; keeps a plug-in's traceback."""
    try:
        yield
    except ConfigError:
        raise
    except LodbenchError as fault:
        each.failure = fault.message if isinstance(fault, QueryFault) else fault.message.rstrip(".")
    except Exception as error:
        keep_traceback(folder, each.entry.key, error)
        each.failure = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


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
    return () if covariance is None else tuple(float(v) for v in covariance[np.triu_indices(6)])
