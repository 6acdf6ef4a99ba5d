"""The first half of a run: a method's answer to every query, stored as it comes; the truth is elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Entry, Query
from lodbench.errors import LodbenchError, QueryFault
from lodbench.evaluation.predictions import Prediction, encoded_mask
from lodbench.execution import Ledger, Progress
from lodbench.geometry import Camera, Pose
from lodbench.harness.runs.prepare import Preparation
from lodbench.methods import Method
from lodbench.methods.protocol import Streams
from lodbench.rendering import Scorer
from lodbench.segmentation import binary_mask
from lodbench.storage import random_stream

PREDICTIONS_FILE = "predictions.jsonl"
# Masks are stored, and compared with the truth, at most at this width, pixels: the paper's fine size.
_MASK_WIDTH = 602


def open_predictions(folder: Path, read_only: bool = False) -> Ledger:
    """Returns the stored predictions of a run folder, as JSON objects by ``Entry.key``."""
    path, older = folder / PREDICTIONS_FILE, folder / "ledger.jsonl"
    return Ledger(older if older.is_file() and not path.is_file() else path, read_only)


def predict(
    method: Method,
    preparation: Preparation,
    scorer: Scorer,
    entries: Sequence[Entry],
    seed: int,
    stored: Ledger,
) -> dict[str, Prediction]:
    """Returns the predictions of some queries by key; those that are stored already are not made again.

    Args:
        method: What finds poses.
        preparation: Makes the queries.
        scorer: Renders the city.
        entries: The queries.
        seed: Of the random streams.
        stored: Where predictions are kept, each before the next query starts.
    """
    dataset = preparation.dataset.name
    _warm_up(scorer)
    with Progress(f"{method.name} on {dataset}", len(entries)) as progress:
        for entry in entries:
            if entry.key not in stored:
                streams = partial(random_stream, seed, dataset, entry.key)
                stored.record(entry.key, _answer(method, preparation, scorer, entry, streams).to_json())
            progress.advance()
    return {entry.key: Prediction.from_json(stored[entry.key]) for entry in entries}


def _warm_up(scorer: Scorer) -> None:
    """Lets the renderer compile, or load what it compiled, before the first query's clock runs."""
    camera = Camera(8, 8, 8.0, 8.0, 4.0, 4.0)
    scorer.counts(camera, np.eye(3)[None], np.zeros((1, 3)), np.zeros((8, 8), dtype=np.bool_))


def _answer(
    method: Method, preparation: Preparation, scorer: Scorer, entry: Entry, streams: Streams
) -> Prediction:
    started = time.perf_counter()
    query = None
    try:
        query = preparation.query(entry)
        prepared = time.perf_counter()
        estimate = method.localize(query, scorer, streams)
        pose = Pose.from_matrix(preparation.in_dataset_frame(estimate.pose).cam_from_world)
    except LodbenchError as fault:
        # A method that answers with no pose has no answer either.
        reason = fault.message if isinstance(fault, QueryFault) else fault.message.rstrip(".")
        return Prediction(None, reason, hypotheses=0, mask_png="" if query is None else _stored_mask(query))
    return Prediction(
        pose=pose,
        score=float(estimate.score) if math.isfinite(estimate.score) else None,
        hypotheses=int(estimate.hypotheses),
        seconds={"prepare": prepared - started, **estimate.seconds},
        trace={stage: tuple(map(float, scores)) for stage, scores in estimate.trace.items()},
        probability=estimate.probability,
        covariance=_upper_triangle(estimate.covariance),
        mask_png=_stored_mask(query),
    )


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
