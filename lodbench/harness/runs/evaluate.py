"""Scoring poses that were made elsewhere, into the artefacts that a run leaves."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from lodbench.datasets.folder import select_splits
from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.datasets.query import Dataset
from lodbench.evaluation.pose_matching import match_poses, suspect_convention
from lodbench.evaluation.predictions import Prediction, evaluate, pose_numbers
from lodbench.evaluation.protocols import protocol_named
from lodbench.geometry import Pose
from lodbench.harness.city import open_city
from lodbench.harness.runs.gallery import write_overlays
from lodbench.harness.runs.prepare import Preparation, prior_of, require_choices
from lodbench.harness.runs.result import Result, chosen_entries, queries_digest
from lodbench.rendering import make_renderer
from lodbench.segmentation import Segmenter
from lodbench.storage import digest_of, make_folder, remove_leftovers
from lodbench.storage.paths import path_name

NO_POSE = "no pose in the pose file"
# What a pose file does not say about how it was made.
UNSTATED = "unstated"


@dataclass(frozen=True, slots=True)
class EvaluateSettings:
    """What is scored, and under which name.

    Attributes:
        poses: The pose file, or folder.
        runs_root: Folder that run folders are made in.
        config: The resolved configuration that defines the result; this module adds what the file is.
        format: ``auto``, or an entry point under ``lodbench.pose_formats``.
        method_name: Name to report; the file's own if empty.
        tilt: Which pitch and roll the method had, as its author says: ``prior`` or ``truth``.
        splits: Splits to score; empty for all.
        limit: At most this many queries per split, or None.
    """

    poses: Path
    runs_root: Path
    config: dict[str, Any] = field(default_factory=dict)
    format: str = "auto"
    method_name: str = ""
    tilt: str = "prior"
    splits: tuple[str, ...] = ()
    limit: int | None = None


def evaluate_poses(dataset: Dataset, settings: EvaluateSettings) -> Result:
    """Returns the scored poses of a file; a query without a pose is a failure and counts.

    Raises:
        LodbenchError: A fault of the file, the dataset or the settings; nothing is scored then.
    """
    name = path_name("method", settings.method_name or re.sub(r"[^\w.+-]+", "_", settings.poses.stem))
    require_choices(settings.tilt, settings.limit)
    splits = select_splits(dataset, settings.splits)
    entries = chosen_entries(dataset, splits, settings.limit)
    known = {word for entry in dataset.entries for word in (entry.name, entry.key)}
    kind, listed = read_pose_file(settings.poses, settings.format, known)
    found, moved = brought(listed, dataset.crs)
    # Matched with all queries: a name of another split is no unknown name.
    matched = match_poses(found, dataset.entries, kind)
    suspicion = suspect_convention(matched.poses, _references(dataset), kind != "c2w")
    notes = moved + matched.notes + ((suspicion,) if suspicion else ())
    inputs = {
        "queries": queries_digest(dataset, entries),
        "poses": digest_of([[pose.name, pose_numbers(pose.pose)] for pose in found]),
    }
    config = {
        **settings.config,
        "method": {"name": name, "variant": "", "format": kind, "notes": list(notes)},
        "segmenter": {"name": UNSTATED},
        "renderer": UNSTATED,
        "seed": UNSTATED,
    }
    runs = settings.runs_root / path_name("dataset", dataset.name) / name
    folder = runs / digest_of({"config": config, "inputs": inputs})
    make_folder(folder)
    remove_leftovers(folder)
    predictions = {entry.key: _prediction(matched.poses.get(entry.key)) for entry in entries}
    priors = {entry.key: prior_of(entry, dataset, settings.tilt) for entry in entries}
    queries = evaluate(
        entries,
        predictions,
        dataset.truth,
        priors,
        tilt=settings.tilt,
        columns=protocol_named(dataset.protocol).columns,
    )
    reported = replace(dataset, notes=dataset.notes + notes)
    return Result(folder, config, reported, splits, predictions, queries, inputs, lod=None)


def draw_scored(result: Result, segmenter: Segmenter, tilt: str) -> list[Path]:
    """Draws the overlays of scored poses over the dataset's city; returns their files.

    Raises:
        CityModelError: The city cannot be read.
    """
    dataset = result.dataset
    if dataset.city_model is None:
        return []
    city = open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height)
    preparation = Preparation(dataset, city.scene, segmenter, tilt)
    renderer = cache(partial(make_renderer, "silhouette", city.scene, None))
    return write_overlays(result, preparation, renderer)


def _references(dataset: Dataset) -> dict[str, Pose]:
    """Returns where the poses should about be: at the truth, or else at the prior."""
    priors = {entry.key: entry.prior for entry in dataset.entries if entry.prior is not None}
    return {**priors, **dataset.truth}


def _prediction(pose: Pose | None) -> Prediction:
    return Prediction(pose, NO_POSE if pose is None else "")
