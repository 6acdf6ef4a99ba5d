"""`lodbench run`: one method over one dataset, or a sweep of them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from lodbench.cli.hydra_app import load_plugin, plain, run_hydra, to_params
from lodbench.cli.sources import profile_of
from lodbench.datasets.query import Dataset
from lodbench.evaluation.rows import seconds_per_query
from lodbench.harness import Run, RunSettings, run_method
from lodbench.harness.artefacts import summary_of, write_artefacts
from lodbench.harness.gallery import write_overlays
from lodbench.reporting.tables import format_text, tables_of

# Settings that never change a result, or are named by content instead: they do not name the run folder.
_NOT_IN_DIGEST = {"paths", "executor"}
_PATHS_IN_DATASET = {"root", "city_model"}
_PATHS_IN_OPTIONS = {"terrain"}


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The settings of a run that belong to no part of it; their meaning is in ``RunSettings``."""

    renderer: str = "silhouette"
    tilt: str = "prior"
    seed: int = 0
    split: list[str] = field(default_factory=list)
    limit: int | None = None


# The runs of this process, for the one table at the end of a sweep.
_finished: list[Run] = []


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    _finished.clear()
    code = run_hydra("run", "run", task, argv)
    if _finished:
        sys.stdout.write(report(_finished))
    return code


def task(config: DictConfig) -> None:
    """Runs one configuration and leaves its run folder; a module-level function, so launchers can ship it."""
    _finished.append(run_config(plain(config)))


def run_config(values: dict[str, Any]) -> Run:
    """Returns the finished run of a resolved configuration, its artefacts written.

    Raises:
        LodbenchError: A fault of the configuration or the dataset, before any work.
    """
    method_type = load_plugin("methods", values["method"]["name"])
    method = method_type(to_params(values["method"], method_type.params_type, "method"))
    segmenter_type = load_plugin("segmenters", values["segmenter"]["name"])
    segmenter = segmenter_type(to_params(values["segmenter"], segmenter_type.params_type, "segmenter"))
    options = to_params({f.name: values[f.name] for f in fields(RunOptions)}, RunOptions, "run")
    dataset = with_source(open_dataset(values["dataset"]), values["source"])
    config = identity_of(values)
    settings = RunSettings(
        runs_root=Path(values["paths"]["runs"]).expanduser(),
        config=config,
        renderer=options.renderer,
        threads=values["executor"]["threads"],
        tilt=options.tilt,
        seed=options.seed,
        splits=tuple(options.split),
        limit=options.limit,
    )
    run = run_method(method, dataset, segmenter, settings)
    write_artefacts(run, OmegaConf.to_yaml(OmegaConf.create(config), sort_keys=True))
    write_overlays(run)
    return run


def identity_of(values: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings that define a result: what names the run folder, with the inputs' content."""
    kept = {key: value for key, value in values.items() if key not in _NOT_IN_DIGEST}
    kept["dataset"] = {k: v for k, v in values["dataset"].items() if k not in _PATHS_IN_DATASET}
    options = values["source"]["options"] or {}
    kept["source"] = {
        **values["source"],
        "options": {k: v for k, v in options.items() if k not in _PATHS_IN_OPTIONS},
    }
    return kept


def report(runs: Sequence[Run]) -> str:
    """Returns the tables of runs and what a reader wants next to them."""
    parts = [format_text(table) for table in tables_of([summary_of(run) for run in runs])]
    lines = []
    for run in runs:
        summary = summary_of(run)
        variant = summary["method"]["variant"]
        name = f"{summary['method']['name']} {variant}".strip()
        for split in run.splits:
            cells = summary["splits"][split]
            seconds, hypotheses = seconds_per_query(run.rows, split), cells["hypotheses_per_query"]
            cost = f"{hypotheses or 0:.0f} hypotheses and {seconds:.2f} s per query"
            lines.append(f"{name}, tilt={run.config['tilt']}, {split}: {cost}")
        lines += [f"  {count} x {reason}" for reason, count in summary["failures"].items()]
        lines += [f"  note: {note}" for note in run.dataset.notes]
        resumed = f" ({run.resumed} queries were there already)" if run.resumed else ""
        lines += [f"  results:  {run.folder}{resumed}", f"  pictures: {run.folder / 'overlays'}"]
    return "\n".join(parts) + "\n" + "\n".join(lines) + "\n"


def open_dataset(values: dict[str, Any]) -> Dataset:
    """Returns the dataset that a configuration's section describes.

    Raises:
        LodbenchError: It is unknown, a setting is wrong, or the data is missing or malformed.
    """
    from inspect import signature

    name = values["name"]
    opener = load_plugin("datasets", name)
    (parameter,) = signature(opener, eval_str=True).parameters.values()
    dataset: Dataset = opener(to_params(values, parameter.annotation, "dataset"))
    return dataset


def with_source(dataset: Dataset, values: dict[str, Any]) -> Dataset:
    """Returns a dataset whose city is read as the source says; the dataset's own words go before it."""
    source = profile_of(values, dataset.city_options.crs)
    lod = source.lod if dataset.lod is None else dataset.lod
    return replace(dataset, lod=lod, city_options=source.options)
