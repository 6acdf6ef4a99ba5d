"""One method over one dataset: every query once, resumable, the same bytes every time."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.folder import select_splits
from lodbench.datasets.pose_direction import require_direction
from lodbench.datasets.prior_sources import prior_digest
from lodbench.datasets.query import Dataset, Entry, Query
from lodbench.errors import ConfigError, LodbenchError, QueryFault
from lodbench.evaluation.rows import QueryRow
from lodbench.execution import Ledger, Progress
from lodbench.geometry import Camera, Pose
from lodbench.harness.city import open_city
from lodbench.harness.runs.code_digest import code_digest
from lodbench.harness.runs.prepare import Preparation, require_tilt
from lodbench.harness.runs.requirements import can_segment, needs_segmenter, require_run_inputs
from lodbench.harness.runs.result import (
    Result,
    chosen_entries,
    errors_of,
    failure_of,
    parts_of,
    pose_numbers,
    queries_digest,
)
from lodbench.harness.runs.status import PLAN_FILE
from lodbench.methods import Method
from lodbench.plugins import load_plugin
from lodbench.rendering import Scorer, make_renderer
from lodbench.segmentation import Segmenter, binary_mask
from lodbench.storage import digest_of, random_stream, write_text

# Masks are compared with the truth at most at this width, pixels: the paper's fine size.
_IOU_WIDTH = 602


@dataclass(frozen=True, slots=True)
class RunSettings:
    """What a run is told besides its method, dataset and segmenter.

    Attributes:
        runs_root: Folder that run folders are made in.
        config: The resolved configuration that defines the result, as JSON values; it names the
            run folder together with the content of the inputs.
        renderer: Name of the renderer.
        threads: Threads of the engine, None for one per core; never changes a result.
        tilt: ``prior`` or ``truth``.
        seed: Seed of the random streams.
        splits: Splits to run; empty for all.
        limit: At most this many queries per split, or None.
    """

    runs_root: Path
    config: dict[str, Any] = field(default_factory=dict)
    renderer: str = "silhouette"
    threads: int | None = None
    tilt: str = "prior"
    seed: int = 0
    splits: tuple[str, ...] = ()
    limit: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Run(Result):
    """A finished run, in memory.

    Attributes:
        preparation: How queries were made from entries.
        scorer: The renderer, for pictures.
        resumed: How many rows were taken from an earlier, interrupted run.
    """

    preparation: Preparation
    scorer: Scorer
    resumed: int


def run_method(method: Method, dataset: Dataset, segmenter: Segmenter, settings: RunSettings) -> Run:
    """Runs a method over a dataset and returns the rows; the ledger in the run folder lets it resume.

    Raises:
        LodbenchError: A fault of the dataset or the settings, before any work is done.
    """
    if settings.limit is not None and settings.limit < 1:
        raise ConfigError(f"limit={settings.limit} is not a number of queries.")
    require_writable(settings.runs_root)
    splits = select_splits(dataset, settings.splits)
    entries = chosen_entries(dataset, splits, settings.limit)
    require_tilt(settings.tilt, dataset)
    load_plugin("renderers", settings.renderer)
    require_run_inputs(method, segmenter, dataset, entries)
    scene, dataset = _open_city(dataset)
    require_direction(dataset, entries, scene)
    preparation = Preparation(dataset, scene, segmenter, settings.tilt, needs_segmenter(method))
    scorer = make_renderer(settings.renderer, scene, settings.threads)
    inputs = {
        "scene": scene_digest(scene),
        "queries": queries_digest(dataset, entries),
        "priors": prior_digest(entries),
        "masks": segmenter.fingerprint(entries) if can_segment(segmenter, dataset, entries) else "",
        "code": code_digest(method, segmenter),
    }
    digest = digest_of({"config": settings.config, "inputs": inputs})
    folder = settings.runs_root / dataset.name / method.name / digest
    ledger = Ledger(folder / "ledger.jsonl")
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / PLAN_FILE, json.dumps({"queries": [entry.key for entry in entries]}, indent=0) + "\n")
    _warm_up(scorer)
    resumed = sum(entry.key in ledger for entry in entries)
    with Progress(f"{method.name} on {dataset.name}", len(entries)) as progress:
        for entry in entries:
            if entry.key not in ledger:
                streams = partial(random_stream, settings.seed, dataset.name, entry.key)
                ledger.record(entry.key, _answer(method, preparation, scorer, entry, streams))
            progress.advance()
    rows = tuple(_row(entry, ledger[entry.key], preparation) for entry in entries)
    return Run(
        folder=folder,
        config=settings.config,
        dataset=dataset,
        splits=splits,
        rows=rows,
        inputs=inputs,
        lod=scene.lod,
        preparation=preparation,
        scorer=scorer,
        resumed=resumed,
    )


def require_writable(folder: Path) -> None:
    """Makes sure, before any work, that a folder exists or can be made, and can be written to.

    Raises:
        ConfigError: It cannot.
    """
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        raise ConfigError(f"Run folders cannot be made in {folder}.", "Set paths.runs=FOLDER.")


def _warm_up(scorer: Scorer) -> None:
    """Lets the renderer compile, or load what it compiled, before the first query's clock runs."""
    camera = Camera(8, 8, 8.0, 8.0, 4.0, 4.0)
    scorer.counts(camera, np.eye(3)[None], np.zeros((1, 3)), np.zeros((8, 8), dtype=np.bool_))


def scene_digest(scene: Scene) -> str:
    """Returns a digest of a city; the same houses elsewhere are another one."""
    return digest_of([scene.digest(), scene.origin.tolist()])


def _open_city(dataset: Dataset) -> tuple[Scene, Dataset]:
    """Returns a dataset's scene, and the dataset with what was met in its city added to the notes."""
    if dataset.city_model is None:
        raise ConfigError("There is no city model to localise against.", dataset.city_hint)
    city = open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height)
    return city.scene, replace(dataset, notes=dataset.notes + city.notes())


def _answer(
    method: Method, preparation: Preparation, scorer: Scorer, entry: Entry, streams: Callable[..., Any]
) -> dict[str, Any]:
    """Returns one query's outcome as JSON values: what the ledger keeps."""
    started = time.perf_counter()
    try:
        query = preparation.query(entry)
        prepared = time.perf_counter()
        estimate = method.localize(query, scorer, streams)
        pose = Pose.from_matrix(preparation.in_dataset_frame(estimate.pose).cam_from_world)
    except LodbenchError as fault:
        # A method that answers with no pose has no answer either.
        reason = fault.message if isinstance(fault, QueryFault) else fault.message.rstrip(".")
        return {"failure": reason, "pose": None, "score": None, "hypotheses": 0, "seconds": {}}
    seconds = {"prepare": prepared - started, **estimate.seconds}
    # Once the clock has stopped: what only the evaluator may compute.
    mask_iou = mask_iou_at_truth(query, preparation, scorer)
    return {
        "mask_iou": mask_iou,
        "trace": {stage: [float(v) for v in scores] for stage, scores in estimate.trace.items()},
        "failure": "",
        "pose": pose_numbers(pose),
        "score": float(estimate.score) if math.isfinite(estimate.score) else None,
        "hypotheses": int(estimate.hypotheses),
        "seconds": seconds,
        "probability": estimate.probability,
        "covariance": upper_triangle(estimate.covariance),
    }


def upper_triangle(covariance: NDArray[np.float64] | None) -> list[float]:
    """Returns the 21 numbers of a (6, 6) covariance on and above its diagonal, row by row; [] for none."""
    return [] if covariance is None else [float(v) for v in covariance[np.triu_indices(6)]]


def mask_iou_at_truth(query: Query, preparation: Preparation, scorer: Scorer) -> float | None:
    """Returns the IoU of a query's mask with the model's silhouette at the truth (paper, Table 4).

    At the mask's own size, or at 602 pixels' width if it is larger; None where there is no truth or
    no mask.
    """
    known = preparation.dataset.truth.get(f"{query.split}/{query.name}")
    if known is None or query.building_probability is None:
        return None
    truth = preparation.local(known)
    height, width = query.building_probability.shape
    if width > _IOU_WIDTH:
        height, width = max(1, round(_IOU_WIDTH * height / width)), _IOU_WIDTH
    mask = binary_mask(query.building_probability, width, height)
    camera = query.camera.scaled(width, height)
    return float(scorer.counts(camera, truth.rotation[None], truth.center[None], mask).iou()[0])


def _row(entry: Entry, answer: dict[str, Any], preparation: Preparation) -> QueryRow:
    matrix = answer["pose"]
    pose = None
    if matrix is not None:
        top = [matrix[0:4], matrix[4:8], matrix[8:12], [0.0, 0.0, 0.0, 1.0]]
        pose = Pose.from_matrix(top)  # type: ignore[arg-type]
    error, prior_error = errors_of(entry, pose, preparation.dataset, preparation.tilt)
    return QueryRow(
        entry.name,
        entry.split,
        pose,
        answer["score"],
        answer["hypotheses"],
        failure_of(entry.key, answer["failure"], preparation.dataset),
        error,
        prior_error,
        answer["seconds"],
        parts_of(entry, pose, preparation.dataset),
        answer.get("mask_iou"),
        {stage: tuple(scores) for stage, scores in answer.get("trace", {}).items()},
        answer.get("probability"),
        tuple(answer.get("covariance", ())),
    )
