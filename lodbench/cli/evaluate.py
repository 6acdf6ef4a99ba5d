"""`lodbench evaluate`: scores anybody's pose file."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from lodbench.cli.hydra_app import plain, run_hydra, section
from lodbench.cli.run_dataset import data_identity, with_date, with_source
from lodbench.datasets.registry import dataset_opener
from lodbench.errors import LodbenchError
from lodbench.harness.runs.artefacts import summary_of, write_artefacts
from lodbench.harness.runs.evaluate import EvaluateSettings, draw_scored, evaluate_poses
from lodbench.harness.runs.result import Result
from lodbench.params import to_params
from lodbench.reporting.aligned_text import plain_text
from lodbench.reporting.table_formats import format_text
from lodbench.reporting.tables import tables_of
from lodbench.segmentation.registry import make_segmenter


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
