"""`lodbench evaluate`: scores anybody's pose file, into the artefacts that a run leaves."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from lodbench.cli.hydra_app import plain, run_hydra, section
from lodbench.cli.run_dataset import data_identity, with_date, with_source
from lodbench.datasets.folder import select_splits
from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.datasets.query import Dataset
from lodbench.datasets.registry import dataset_opener
from lodbench.errors import LodbenchError
from lodbench.evaluation.predictions import (
    Prediction,
    evaluate,
    match_poses,
    pose_numbers,
    suspect_convention,
)
from lodbench.evaluation.queries import protocol_named
from lodbench.geometry import Pose
from lodbench.harness.city import open_city
from lodbench.harness.runs.artefacts import Result, summary_of, write_artefacts
from lodbench.harness.runs.gallery import write_overlays
from lodbench.harness.runs.inputs import chosen_entries, queries_digest
from lodbench.harness.runs.queries import Preparation, prior_of
from lodbench.harness.runs.requirements import require_choices
from lodbench.params import to_params
from lodbench.rendering import make_renderer
from lodbench.reporting.aligned_text import plain_text
from lodbench.reporting.tables import format_text, tables_of
from lodbench.segmentation import Segmenter
from lodbench.segmentation.protocol import make_segmenter
from lodbench.storage import digest_of, make_folder, remove_leftovers
from lodbench.storage.paths import path_name


@dataclass(frozen=True, slots=True)
class EvaluateOptions:
    """The settings of the command that belong to no part of it; see ``EvaluateSettings``."""

    poses: str
    format: str = "auto"
    method_name: str | None = None
    tilt: str = "prior"
    split: list[str] = field(default_factory=list)
    limit: int | None = None


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    return run_hydra("evaluate", "evaluate", task, argv)


def task(config: DictConfig) -> None:
    """Scores one pose file and leaves a run folder."""
    # Poses are compared with poses: a city model adds nothing, so it need not be there.
    if OmegaConf.is_missing(config.dataset, "city_model"):
        config.dataset.city_model = None
    values = plain(config)
    options = to_params(
        {f.name: values[f.name] for f in fields(EvaluateOptions)}, EvaluateOptions, "evaluate"
    )
    opener, dataset_params = dataset_opener(section(values, "dataset"))
    source = section(values, "source")
    dataset, source = with_date(with_source(opener(dataset_params), source), source)
    named = {"poses", "format", "method_name", "paths", "executor", "dataset", "source"}
    plain_settings = {key: value for key, value in values.items() if key not in named}
    settings = EvaluateSettings(
        poses=Path(options.poses).expanduser(),
        runs_root=Path(values["paths"]["runs"]).expanduser(),
        config={**plain_settings, "split": options.split, **data_identity(dataset_params, source)},
        format=options.format,
        method_name=options.method_name or "",
        tilt=options.tilt,
        splits=tuple(options.split),
        limit=options.limit,
    )
    result = evaluate_poses(dataset, settings)
    write_artefacts(result, OmegaConf.to_yaml(OmegaConf.create(result.config), sort_keys=True))
    city = result.dataset.city_model
    if city is not None and city.exists():
        try:
            draw_scored(result, make_segmenter("masks")[0], settings.tilt)
        except LodbenchError as fault:
            # The table stands; only the pictures need the city.
            sys.stderr.write(f"lodbench: no pictures: {fault.message}\n")
    sys.stdout.write(report(result))


def report(result: Result) -> str:
    """Returns the table of a scored file and what a reader wants next to it."""
    summary = summary_of(result)
    parts = [format_text(table) for table in tables_of([summary])]
    lines = [f"  {count} x {reason}" for reason, count in summary["failures"].items()]
    lines += [f"  note: {plain_text(note)}" for note in result.dataset.notes]
    lines += [f"  read as: {result.config['method']['format']}", f"  results: {result.folder}"]
    return "\n".join([*parts, *lines]) + "\n"


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
