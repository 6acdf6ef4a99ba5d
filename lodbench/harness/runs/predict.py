"""The first half of a run: a method's answer to every query, stored as it comes; the truth is elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.textured_map import open_textured_map
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset, Entry, Reference
from lodbench.errors import DatasetError
from lodbench.evaluation.predictions import Prediction
from lodbench.execution import Ledger, Progress
from lodbench.execution.executor import (
    QUERIES,
    SERIAL,
    ExecutorParams,
    Workers,
    open_workers,
    require_code_version,
)
from lodbench.geometry import Camera
from lodbench.harness.city import city_digests, city_of_dataset
from lodbench.harness.runs.inputs import prepare_method
from lodbench.harness.runs.queries import PendingQuery, Preparation, answer
from lodbench.methods import Method
from lodbench.methods.protocol import Streams, SupportsBatches, SupportsFlights
from lodbench.plugins import blaming
from lodbench.rendering import Fit, IouCounts, IouFit, Scorer
from lodbench.rendering.projection import nearby_order
from lodbench.segmentation import Segmenter
from lodbench.storage import random_stream
from lodbench.storage.digest import remember_contents

Floats = NDArray[np.float64]

# Hypotheses handed to a worker at a time: a second or so of work, against milliseconds to send them.
PART = 4096
PREDICTIONS_FILE = "predictions.jsonl"


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Some hypotheses of a call."""

    which: NDArray[np.int64]  # their places in the call
    camera: Camera  # pinhole
    rotations: Floats  # (N, 3, 3) cam_from_world
    centers: Floats  # (N, 3) camera centres, scene metres
    fit: Fit  # what they are compared with


def score(scorer: Scorer, part: Part) -> tuple[NDArray[np.int64], tuple[NDArray[Any], ...]]:
    """Returns the places of hypotheses and what they score: intersection and union for an ``IouFit``."""
    if isinstance(part.fit, IouFit):
        counts = scorer.counts(part.camera, part.rotations, part.centers, part.fit.mask)
        return part.which, (counts.intersection, counts.union)
    return part.which, (scorer.fit(part.camera, part.rotations, part.centers, part.fit),)


class SharedScorer:
    """A renderer that shares large calls of ``counts`` and ``fit`` out over workers, no others."""

    def __init__(self, own: Scorer, workers: Workers, work: Any, part: int = PART) -> None:
        self._own, self._workers, self._work, self._part = own, workers, work, part

    def __getattr__(self, name: str) -> Any:
        return getattr(self._own, name)

    def counts(
        self, camera: Camera, rotations: Floats, centers: Floats, mask: NDArray[np.bool_]
    ) -> IouCounts:
        """Counts as ``Scorer.counts`` does."""
        if len(centers) < 2 * self._part:
            return self._own.counts(camera, rotations, centers, mask)
        return IouCounts(*self._shared(camera, rotations, centers, IouFit(mask), (np.int64, np.int64)))

    def fit(self, camera: Camera, rotations: Floats, centers: Floats, fit: Fit) -> Floats:
        """Compares as ``Scorer.fit`` does."""
        if isinstance(fit, IouFit):
            return self.counts(camera, rotations, centers, fit.mask).iou()
        if len(centers) < 2 * self._part:
            return self._own.fit(camera, rotations, centers, fit)
        return self._shared(camera, rotations, centers, fit, (np.float64,))[0]

    def _shared(
        self, camera: Camera, rotations: Floats, centers: Floats, fit: Fit, kinds: tuple[type, ...]
    ) -> tuple[NDArray[Any], ...]:
        """Returns what each hypothesis scores, whatever the order in which parts come back."""
        results: tuple[NDArray[Any], ...] = tuple(np.zeros(len(centers), dtype=kind) for kind in kinds)
        # Neighbours see much the same buildings: a part of them is drawn faster than one of all places.
        order = nearby_order(rotations, centers)

        def parts() -> Iterator[Part]:
            for start in range(0, len(order), self._part):
                which = order[start : start + self._part]
                yield Part(which, camera, rotations[which], centers[which], fit)

        for which, scored in self._workers.map(self._work, parts()):
            for result, values in zip(results, scored, strict=True):
                result[which] = values
        return results


def open_predictions(folder: Path, read_only: bool = False) -> Ledger:
    """Returns the stored predictions of a run folder, as JSON objects by ``Entry.key``."""
    path, older = folder / PREDICTIONS_FILE, folder / "ledger.jsonl"
    return Ledger(older if older.is_file() and not path.is_file() else path, read_only)


@dataclass(frozen=True, slots=True, eq=False)
class Work:
    """What a process needs to answer queries: the city is opened there, from the cache."""

    method: Method
    dataset: Dataset
    segmenter: Segmenter
    renderer: str
    threads: int | None  # of the renderer; None for one per core
    tilt: str
    needs: frozenset[Input]
    seed: int
    params: object
    inputs: dict[str, str]
    folder: Path
    # SHA-256 of the files that are read again for single queries.
    contents: Mapping[Path, str] = field(default_factory=dict)
    stream_names: Callable[[Entry], tuple[str, ...]] | None = None
    # Digest of the command's code and libraries (``own_digest``), "" where workers have no others.
    code: str = ""

    def streams_of(self, entry: Entry) -> Streams:
        """Returns the random numbers of a query: never by worker or order."""
        names = (self.dataset.name, entry.key) if self.stream_names is None else self.stream_names(entry)
        return partial(random_stream, self.seed, *names)

    def prepared_with(
        self, city_map: CityMap
    ) -> tuple[Method, object, dict[str, str], CityMap, tuple[Reference, ...], Path]:
        """Returns the arguments of ``prepare_method``."""
        return self.method, self.params, self.inputs, city_map, self.dataset.references, self.folder

    def answers(
        self, preparation: Preparation, city_map: CityMap, entries: Sequence[Entry]
    ) -> list[tuple[str, dict[str, Any]]]:
        """Returns the keys of queries and the predictions of their poses as JSON values."""
        given = [PendingQuery(entry, self.streams_of(entry)) for entry in entries]
        answer(self.method, preparation, city_map, given, self.folder)
        return [(each.entry.key, each.prediction(preparation, self.folder).to_json()) for each in given]


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
        retries_failed: Whether queries whose stored prediction is a failure are tried again.

    Raises:
        ConfigError: A setting of the method or the segmenter is wrong, which only a query could tell.
        InputChanged: A photo or mask is another than when the run began.
        WorkersGone: Workers keep dying, or the scheduler is not there.
    """
    stored = open_predictions(work.folder)
    waiting = [e for e in entries if e.key not in stored or (retries_failed and stored[e.key]["failure"])]
    again = {entry.key for entry in waiting}
    batches = _batches(work.method, entries, waiting)
    label, done = f"{work.method.name} on {work.dataset.name}", len(entries) - len(waiting)
    with Progress(label, len(entries), done=done) as progress:
        for answered in _answers(work, preparation, city_map, batches, executor):
            for key, answer in answered:
                if key in again:
                    stored.record(key, answer)
                    progress.advance()
    return {
        entry.key: Prediction.from_json(stored[entry.key], f"{work.folder / PREDICTIONS_FILE}: {entry.key}")
        for entry in entries
    }


def _answers(
    work: Work,
    preparation: Preparation,
    city_map: CityMap,
    batches: Sequence[Sequence[Entry]],
    executor: ExecutorParams,
) -> Iterator[list[tuple[str, dict[str, Any]]]]:
    if executor.name == SERIAL:
        if batches:
            _warm_up(city_map)
        for batch in batches:
            yield work.answers(preparation, city_map, batch)
        return
    with open_workers(executor, _open_here, (work,)) as workers:
        if executor.share == QUERIES:
            yield from workers.map(_answer_here, batches)
            return
        # The process that was started goes on by itself, and has workers score its large grids.
        prepare_method(*work.prepared_with(city_map))
        shared = SharedScorer(city_map.scorer, workers, _score_here)
        shared_map = city_map.with_scorer(cast("Scorer", shared))
        for batch in batches:
            yield work.answers(preparation, shared_map, batch)


def _batches(method: Method, entries: Sequence[Entry], waiting: Sequence[Entry]) -> list[list[Entry]]:
    """Returns the queries that are answered together: whole flights where any of their photos waits."""
    if isinstance(method, SupportsFlights):
        flights: dict[tuple[str, str], list[Entry]] = {}
        for entry in entries:
            flights.setdefault((entry.split, entry.sequence), []).append(entry)
        wanted = {(entry.split, entry.sequence) for entry in waiting}
        return [photos for flight, photos in flights.items() if flight in wanted]
    size = method.batch_size if isinstance(method, SupportsBatches) else 1
    return [list(waiting[start : start + size]) for start in range(0, len(waiting), size)]


# What this worker process has opened; set once, before its first query.
_here: list[tuple[Work, Preparation, CityMap]] = []


def _open_here(work: Work) -> None:
    require_code_version(work.code)
    remember_contents(work.contents)
    dataset = work.dataset
    scene = city_of_dataset(dataset).scene
    textured = None
    if dataset.textured_map is not None:
        textured = open_textured_map(dataset.textured_map, scene, options=dataset.city_options)
    digests = {"roofs": "", "textured_map": "" if textured is None else textured.digest()}
    digests |= city_digests(scene)
    if any(work.inputs.get(name, "") != digest for name, digest in digests.items()):
        reason = f"{dataset.city_model} is another city for a worker, or has changed since the start."
        raise DatasetError(reason, "Let all workers see the same files.")
    city_map = CityMap(scene, work.renderer, work.threads, textured)
    preparation = Preparation(dataset, scene, work.segmenter, work.tilt, work.needs, city_map)
    # It finds prepared what the run's own process prepared.
    prepare_method(*work.prepared_with(city_map))
    _warm_up(city_map)
    _here[:] = [(work, preparation, city_map)]


def _answer_here(entries: Sequence[Entry]) -> list[tuple[str, dict[str, Any]]]:
    work, preparation, city_map = _here[0]
    return work.answers(preparation, city_map, entries)


def _score_here(part: Part) -> tuple[NDArray[np.int64], tuple[NDArray[Any], ...]]:
    return score(_here[0][2].scorer, part)


def _warm_up(city_map: CityMap) -> None:
    """Lets the renderer compile, or load what it compiled, before the first query's clock runs."""
    camera = Camera(8, 8, 8.0, 8.0, 4.0, 4.0)
    with blaming("renderers", city_map.name, "draw"):
        city_map.counts(camera, np.eye(3)[None], np.zeros((1, 3)), np.zeros((8, 8), dtype=np.bool_))
