"""`lodbench run`: one method over one dataset, or a sweep; `lodbench basin`: over ever wider priors."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from lodbench.cli.hydra_app import plain, run_hydra, section
from lodbench.cli.parts import default_segmenter, named_segmenter
from lodbench.cli.run_dataset import (
    data_identity,
    made_method,
    offer_methods,
    with_date,
    with_masks,
    with_prior,
    with_source,
)
from lodbench.datasets.registry import dataset_opener
from lodbench.errors import ConfigError
from lodbench.evaluation.basin import BasinStep, basin_steps, protocol_lines
from lodbench.evaluation.queries import ERROR, has_truth, is_answered, without_truth
from lodbench.execution.executor import ExecutorParams
from lodbench.harness import Run, RunSettings, run_method
from lodbench.harness.remote.method import INPROCESS, RunnerParams
from lodbench.harness.runs.artefacts import queries_text, summary_of, write_artefacts
from lodbench.harness.runs.basin import Basin, CostGrid, write_basin
from lodbench.harness.runs.gallery import chosen_queries, overlay_name, write_overlays
from lodbench.harness.runs.requirements import SEGMENTED, require_choices, segmented_inputs
from lodbench.harness.runs.run import required_queries
from lodbench.harness.tracebacks import traceback_file
from lodbench.methods.protocol import SupportsPriorWidth
from lodbench.methods.registry import configure_method
from lodbench.params import to_params
from lodbench.plugins import load_plugin
from lodbench.reporting.aligned_text import already_there, plain_lines, plain_text
from lodbench.reporting.answers import format_answers, untrusted_note
from lodbench.reporting.summaries import with_settings
from lodbench.reporting.tables import RecallTable, format_text, tables_of
from lodbench.segmentation import notes_of

_SECTIONS = {"method", "dataset", "segmenter", "source", "prior", "executor", "runner", "paths"}


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The settings of a run that belong to no part of it; their meaning is in ``RunSettings``."""

    renderer: str = "silhouette"
    tilt: str = "prior"
    seed: int = 0
    split: list[str] = field(default_factory=list)
    limit: int | None = None

    def __post_init__(self) -> None:
        require_choices(self.tilt, self.limit)
        load_plugin("renderers", self.renderer)


@dataclass(frozen=True, slots=True)
class PathParams:
    """Where results go, and where datasets lie: None for ``LODBENCH_DATA`` or the user's own folder."""

    runs: str = "runs"
    data_root: str | None = None

    def __post_init__(self) -> None:
        if not self.runs:
            raise ConfigError("paths.runs is empty.", "Set paths.runs=FOLDER.")


# Asks queries again that failed before; no setting, for it changes no run's name.
RETRY = "--retry-failed"
_flags: set[str] = set()

# The runs of this process, for the one table at the end of a sweep.
_finished: list[Run] = []


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    _finished.clear()
    _flags.clear()
    _flags.update(word for word in argv if word == RETRY)
    offer_methods(argv)
    code = run_hydra("run", "run", task, [word for word in argv if word != RETRY])
    if _finished:
        sys.stdout.write(report(_finished) + picture_to_open(_finished))
    return code or int(any(_is_fruitless(run) for run in _finished))


def task(config: DictConfig) -> None:
    """Runs one configuration and leaves its run folder; a module-level function, so launchers can ship it."""
    _finished.append(run_config(plain(config)))


def run_config(values: dict[str, Any]) -> Run:
    """Returns the finished run of a resolved configuration, its artefacts written.

    Raises:
        LodbenchError: A fault of the configuration or the dataset, before any work.
    """
    options = _options_of(values)
    executor = to_params(section(values, "executor"), ExecutorParams, "executor")
    paths = to_params(section(values, "paths"), PathParams, "paths")
    # A basin has no other: its prior widths are given to a method in this process.
    runner = to_params(section({"runner": {}, **values}, "runner"), RunnerParams, "runner")
    method, params = made_method(section(values, "method"), runner, options.tilt)
    named = named_segmenter(section(values, "segmenter"))
    opener, dataset_params = dataset_opener(section(values, "dataset"))
    source = section(values, "source")
    dataset = with_source(opener(dataset_params), source)
    dataset = with_masks(dataset, section(values, "segmenter"))
    segmenter, segmenter_params = named or default_segmenter(
        dataset, segmented_inputs(method), tuple(options.split)
    )
    dataset, prior = with_prior(dataset, section(values, "prior"), options.seed)
    config = {
        **asdict(options),
        "prior": prior,
        "method": params,
        # Left out where it is the process itself, as in all runs before there was a choice.
        **({} if runner.name == INPROCESS else {"runner": runner.name}),
        # So is the folder of masks where it is the dataset's own.
        "segmenter": {k: v for k, v in asdict(segmenter_params).items() if (k, v) != ("folder", None)},
    }
    settings = RunSettings(
        runs_root=Path(paths.runs).expanduser(),
        config=config,
        renderer=options.renderer,
        threads=executor.threads,
        tilt=options.tilt,
        seed=options.seed,
        splits=tuple(options.split),
        limit=options.limit,
        retries_failed=RETRY in _flags,
        executor=executor,
    )
    required_queries(method, dataset, segmenter, settings)  # before the city is read
    dataset, source = with_date(dataset, source)
    config |= data_identity(dataset_params, source)
    run = run_method(method, dataset, segmenter, settings)
    before = queries_text(run.folder)
    write_artefacts(run, OmegaConf.to_yaml(OmegaConf.create(config), sort_keys=True))
    was_written = run.resumed == len(run.predictions) and before == queries_text(run.folder)
    write_overlays(run, run.preparation, lambda: run.scorer, was_written)
    return run


def _is_fruitless(run: Run) -> bool:
    """Tells whether every query of a run failed."""
    return bool(run.predictions) and all(found.pose is None for found in run.predictions.values())


def _options_of(values: dict[str, Any]) -> RunOptions:
    """Returns the settings that belong to no section; nothing else may stand beside the sections."""
    plain_keys = {key: value for key, value in values.items() if key not in _SECTIONS}
    options = to_params(plain_keys, RunOptions, "")
    return replace(options, split=sorted(set(options.split)))


def report(runs: Sequence[Run]) -> str:
    """Returns the tables of runs and what a reader wants next to them."""
    summaries = [with_settings(summary_of(run), run.config, run.dataset.city_model) for run in runs]
    scored = [has_truth(run.queries).any() for run in runs]
    pairs = zip(summaries, scored, strict=True)
    valid = [summary for summary, is_scored in pairs if is_scored and "invalid" not in summary]
    tables = tables_of(valid)
    parts = [format_text(table) for table in tables]
    unscored = [without_truth(run.queries) for run in runs]
    parts += [
        format_answers(queries, run.predictions)
        for run, queries in zip(runs, unscored, strict=True)
        if len(queries)
    ]
    parts += [_calibration_text(table) for table in tables if "ece_percent" in table.numbers()]
    lines = []
    for run, summary in zip(runs, summaries, strict=True):
        if "invalid" in summary:
            lines.append(f"INVALID, excluded from tables: {summary['invalid']}")
        variant = summary["method"]["variant"]
        name = f"{summary['method']['name']} {variant}".strip()
        for split in run.splits:
            cells = summary["splits"][split]
            seconds, hypotheses = run.seconds_per_query(split), cells["hypotheses_per_query"]
            if hypotheses is not None:
                cost = f"{hypotheses:.0f} hypotheses and {seconds:.2f} s per query"
                lines.append(f"{name}, tilt={run.config['tilt']}, {split}: {cost}")
        lines += _failure_lines(run)
        untrusted = untrusted_note(run.predictions.values())
        lines += [f"  {untrusted}"] if untrusted else []
        has_masks = bool(run.preparation.needs & SEGMENTED)
        notes = (*(notes_of(run.preparation.segmenter) if has_masks else ()), *run.dataset.notes)
        lines += [f"  note: {plain_text(note)}" for note in notes]
        lines += [
            f"  results:  {run.folder}{already_there(run.resumed, 'queries')}",
            f"  pictures: {run.folder / 'overlays'}",
        ]
    return "\n".join(parts) + "\n" + "\n".join(lines) + "\n"


def picture_to_open(runs: Sequence[Run]) -> str:
    """Returns a line that names one picture: the best query of the last split, of the run that did best."""

    def middle(run: Run) -> float:
        return float(run.queries[ERROR[0]].fillna(math.inf).median())

    for run in sorted(runs, key=middle):
        found = run.queries[is_answered(run.queries)]
        for split in reversed(run.splits):
            kind, chosen = next(iter(chosen_queries(found, split).items()))
            for _, row in chosen[:1].iterrows():
                path = run.folder / "overlays" / overlay_name(split, kind, 1, row["query"])
                if path.is_file():
                    name = run.config["method"]["name"]
                    return f"Open {path}: the map's outlines at the prior and at the pose of {name}.\n"
    return ""


def _calibration_text(table: RecallTable) -> str:
    shown = replace(table.with_columns("calibration"), title=f"Calibration: {table.title}")
    return (
        format_text(shown) + "mean_confidence: mean probability of being within (2 m, 2 deg); ece: expected "
        "calibration error, its distance from the share within; aurc: area under the risk-coverage curve: "
        "share not within as the most confident 0 to 100 % are answered; all in percent.\n"
    )


def _failure_lines(run: Run) -> list[str]:
    """Returns per reason how many queries failed, the first of their names, and where code raised."""
    # Splits without a truth have said above what became of each query.
    reported = run.queries.drop(without_truth(run.queries).index)
    failed = reported["failure"][reported["failure"] != ""].map(plain_text)
    reasons = {reason: list(failed.index[failed == reason]) for reason in sorted(failed.unique())}
    lines = []
    for reason, keys in reasons.items():
        more = ", ... (all in queries.csv)" if len(keys) > 3 else ""
        lines.append(f"  {len(keys)} x {reason}: {', '.join(map(plain_text, keys[:3]))}{more}")
        raised = traceback_file(run.folder, keys[0])
        if raised.is_file():
            traced = plain_lines(raised.read_text(encoding="utf-8"))
            lines += [f"    {line}" for line in traced.splitlines()]
    return lines


@dataclass(frozen=True, slots=True)
class BasinOptions:
    """The settings of the command that are not a run's.

    Attributes:
        ranges: Half widths in x, y and z, metres.
        yaw_ranges: Half widths in yaw, degrees.
        limits: Queries per split by range; None for ``limit`` in all.
        maps: Whether to measure the cost around the truth.
    """

    ranges: list[float] = field(default_factory=list)
    yaw_ranges: list[float] = field(default_factory=list)
    limits: list[int | None] | None = None
    maps: bool = True


def main_basin(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    return run_hydra("basin", "basin", basin_task, argv)


def basin_task(config: DictConfig) -> None:
    """Runs one basin and leaves its folder, and those of its runs."""
    values = plain(config)
    options = to_params(
        {key: values.pop(key) for key in ("ranges", "yaw_ranges", "limits", "maps")}, BasinOptions, ""
    )
    steps = basin_steps(options.ranges, options.yaw_ranges, options.limits or [values["limit"]])
    # Apart from other runs, of which a pattern such as runs/demo/*/* is.
    values["paths"] = {**values["paths"], "runs": str(Path(values["paths"]["runs"]) / "basin")}
    # Every step's configuration is made before the first one runs: a fault stops before any work.
    jobs = [(step, _configuration(values, step)) for step in steps]
    is_told = isinstance(configure_method(section(values, "method")).make(), SupportsPriorWidth)
    basin = Basin(tuple(protocol_lines(values["tilt"], values["seed"], is_told)), [])
    for step, job in jobs:
        run = run_config(job)
        basin.add(step, run)
        sys.stderr.write(f"{step.label}: {_cost(basin, step)}\n")
    folder = write_basin(basin, CostGrid() if options.maps else None)
    sys.stdout.write(basin_report(basin, folder))


def basin_report(basin: Basin, folder: Path) -> str:
    """Returns the tables, the protocol and what they cost."""
    parts = [format_text(table) for table in basin.tables()]
    lines = ["protocol:", *(f"  {line}" for line in basin.protocol)]
    lines += [f"{step.label}: {_cost(basin, step)}" for step, _ in basin.steps]
    return "\n".join([*parts, *lines, f"  results: {folder}", ""])


def _cost(basin: Basin, step: BasinStep) -> str:
    run = basin.run_of(step)
    words = []
    for split in run.splits:
        hypotheses = basin.summary(step, split).hypotheses_per_query
        seconds = run.seconds_per_query(split)
        words.append(f"{split}: {hypotheses:.0f} hypotheses and {seconds:.2f} s per query")
    return "; ".join(words)


def _configuration(values: dict[str, Any], step: BasinStep) -> dict[str, Any]:
    """Returns the configuration of a step's run: that of `lodbench run` with prior=uniform."""
    prior = step.prior()
    method = configure_method(section(values, "method")).for_prior(prior)
    limit = step.limit if step.limit is not None else values["limit"]
    if limit is not None and limit < 1:
        raise ConfigError(f"limit={limit} is not a number of queries.")
    return {
        **values,
        "method": asdict(method.params),
        "prior": {"name": "uniform", **asdict(prior)},
        "limit": limit,
    }
