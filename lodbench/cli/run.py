"""`lodbench run`: one method over one dataset, or a sweep; `lodbench basin`: over ever wider priors.

At the end what other commands open too: the dataset of a configuration with its priors and city, and the
process that its method runs in.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from lodbench.citymodel.attributes import date_in
from lodbench.citymodel.options import PATH_OPTIONS
from lodbench.cli.hydra_app import plain, run_hydra, section
from lodbench.cli.options import default_segmenter, named_segmenter, option_pairs, profile_of
from lodbench.cli.settings import settings_of
from lodbench.datasets.own import find_mask, require_some_mask
from lodbench.datasets.prior_sources import FilePrior, prior_digest
from lodbench.datasets.query import Dataset
from lodbench.datasets.registry import dataset_opener, draw_priors, make_priors
from lodbench.errors import ConfigError, LodbenchError
from lodbench.evaluation.metrics import ERROR, has_truth, is_answered, without_truth
from lodbench.execution.executor import ExecutorParams
from lodbench.findings import FAULT, OK, Check
from lodbench.harness import Run, RunSettings, run_method
from lodbench.harness.city import open_city
from lodbench.harness.remote.method import INPROCESS, SUBPROCESS, RemoteMethod, RunnerParams
from lodbench.harness.remote.process import RunnerFault
from lodbench.harness.runs import artefacts, gallery, requirements
from lodbench.harness.runs.basin import Basin, BasinStep, CostGrid, basin_steps, protocol_lines, write_basin
from lodbench.harness.runs.run import required_queries
from lodbench.harness.tracebacks import traceback_file
from lodbench.methods import Method
from lodbench.methods.protocol import SupportsPriorWidth
from lodbench.methods.registry import configure_method
from lodbench.params import to_params
from lodbench.plugins import config_files, load_plugin
from lodbench.reporting.aligned_text import already_there, plain_lines, plain_text
from lodbench.reporting.answers import format_answers, untrusted_note
from lodbench.reporting.summaries import with_settings
from lodbench.reporting.tables import RecallTable, format_text, tables_of
from lodbench.segmentation import notes_of

_SECTIONS = {"method", "dataset", "segmenter", "source", "prior", "executor", "runner", "paths"}
# Asks queries again that failed before; no setting, for it changes no run's name.
RETRY = "--retry-failed"
_flags: set[str] = set()
# The runs of this process, for the one table at the end of a sweep.
_finished: list[Run] = []
# What names the run folder leaves out paths, whose content is named instead, and how work is spread.
# The origin of a published dataset is withheld for privacy, so it is not written down either.
_PATHS_IN_DATASET = {"root", "city_model", "origin"}
_PREFIX = "runner."


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The settings of a run that belong to no part of it; their meaning is in ``RunSettings``."""

    renderer: str = "silhouette"
    tilt: str = "prior"
    seed: int = 0
    split: list[str] = field(default_factory=list)
    limit: int | None = None

    def __post_init__(self) -> None:
        requirements.require_choices(self.tilt, self.limit)
        load_plugin("renderers", self.renderer)


@dataclass(frozen=True, slots=True)
class PathParams:
    """Where results go, and where datasets lie: None for ``LODBENCH_DATA`` or the user's own folder."""

    runs: str = "runs"
    data_root: str | None = None

    def __post_init__(self) -> None:
        if not self.runs:
            raise ConfigError("paths.runs is empty.", "Set paths.runs=FOLDER.")


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
        dataset, requirements.segmented_inputs(method), tuple(options.split)
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
    before = artefacts.queries_text(run.folder)
    artefacts.write_artefacts(run, OmegaConf.to_yaml(OmegaConf.create(config), sort_keys=True))
    was_written = run.resumed == len(run.predictions) and before == artefacts.queries_text(run.folder)
    gallery.write_overlays(run, run.preparation, lambda: run.scorer, was_written)
    return run


def _is_fruitless(run: Run) -> bool:
    """Tells whether every query of a run failed."""
    return bool(run.predictions) and all(prediction.pose is None for prediction in run.predictions.values())


def _options_of(values: dict[str, Any]) -> RunOptions:
    """Returns the settings that belong to no section; nothing else may stand beside the sections."""
    plain_keys = {key: value for key, value in values.items() if key not in _SECTIONS}
    options = to_params(plain_keys, RunOptions, "")
    return replace(options, split=sorted(set(options.split)))


def report(runs: Sequence[Run]) -> str:
    """Returns the tables of runs and what a reader wants next to them."""
    summaries = [with_settings(artefacts.summary_of(run), run.config, run.dataset.city_model) for run in runs]
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
        has_masks = bool(run.preparation.needs & requirements.SEGMENTED)
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
        answered = run.queries[is_answered(run.queries)]
        for split in reversed(run.splits):
            kind, chosen = next(iter(gallery.chosen_queries(answered, split).items()))
            for _, row in chosen[:1].iterrows():
                path = run.folder / "overlays" / gallery.overlay_name(split, kind, 1, row["query"])
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
    """The settings of the command that are not a run's."""

    ranges: list[float] = field(default_factory=list)  # half widths in x, y and z, metres
    yaw_ranges: list[float] = field(default_factory=list)  # half widths in yaw, degrees
    limits: list[int | None] | None = None  # queries per split by range; None for ``limit`` in all
    maps: bool = True  # whether to measure the cost around the truth


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
    takes_width = isinstance(configure_method(section(values, "method")).make(), SupportsPriorWidth)
    basin = Basin(tuple(protocol_lines(values["tilt"], values["seed"], takes_width)), [])
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


def data_identity(dataset_params: Any, source: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings of a dataset and its source, less paths: their content is named instead."""
    options = _without(source.get("options") or {}, set(PATH_OPTIONS))
    return {
        "dataset": _without(asdict(dataset_params), _PATHS_IN_DATASET),
        "source": {**source, "options": options},
    }


def with_prior(dataset: Dataset, values: dict[str, Any], seed: int) -> tuple[Dataset, dict[str, Any]]:
    """Returns a dataset with the priors a section asks for, and that section checked.

    In it the digest of a file of priors stands for its path.

    Raises:
        LodbenchError: The kind of prior is unknown, a setting is wrong, or the priors cannot be had.
    """
    name, settings = str(values.get("name", "")), {key: v for key, v in values.items() if key != "name"}
    priors = make_priors(name, settings)
    dataset = draw_priors(dataset, name, priors, seed)
    stated = {"name": name, **asdict(priors)}  # type: ignore[call-overload]
    if name == FilePrior.name:
        stated = {"name": name}
        if settings.get("path") is not None:
            stated["content"] = prior_digest(dataset.entries)
    return dataset, stated


def with_source(dataset: Dataset, values: dict[str, Any]) -> Dataset:
    """Returns a dataset whose city is read as the source says; the dataset's own words go before it."""
    source = profile_of(values, dataset.city_options.crs)
    lod = source.lod if dataset.lod is None else dataset.lod
    # The frame of the data is no habit of a publisher: it was stated by the data.
    own = dataset.city_options
    layers = own.layers or source.options.layers
    options = replace(source.options, ecef_origin=own.ecef_origin, layers=layers)
    textured = dataset.textured_map
    if textured is None and options.orthophoto is not None:
        textured = dataset.city_model  # a surface model under its orthophoto
    return replace(dataset, lod=lod, city_options=options, textured_map=textured)


def with_masks(dataset: Dataset, segmenter: dict[str, Any]) -> Dataset:
    """Returns a dataset with the masks of ``segmenter.folder`` in place of its own, where that is set.

    Raises:
        DatasetError: There is no mask of any photo.
    """
    if segmenter.get("name") != "masks" or not segmenter.get("folder"):
        return dataset
    folder, entries = Path(segmenter["folder"]).expanduser(), dataset.entries
    require_some_mask(folder, [entry.name for entry in entries], [entry.image for entry in entries])
    return replace(
        dataset, entries=tuple(replace(e, mask=find_mask(folder, e.name, e.image)) for e in entries)
    )


def with_date(dataset: Dataset, values: dict[str, Any]) -> tuple[Dataset, dict[str, Any]]:
    """Returns a dataset and its source with the date at which its city stood, where any building has an end.

    So a run is one of that date: it reads the same city on any later day.

    Raises:
        CityModelError: The city cannot be read, or has no building at the level of the dataset.
    """
    options = dataset.city_options
    if dataset.city_model is None or options.date is not None:
        return dataset, values
    period = open_city(dataset.city_model, dataset.lod, options, dataset.roof_height).period
    if period is None:
        return dataset, values
    day = date_in(period)
    dated = {**values, "options": {**(values.get("options") or {}), "date": day}}
    return replace(dataset, city_options=replace(options, date=day)), dated


def _without(values: dict[str, Any], names: set[str]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key not in names}


def made_method(values: Mapping[str, Any], runner: RunnerParams, tilt: str) -> tuple[Method, dict[str, Any]]:
    """Returns the method of a configuration's section where it is to run, and its parameters.

    Raises:
        ConfigError: It is unknown, a setting is wrong, or the other Python cannot run it.
    """
    if runner.name == INPROCESS:
        configured = configure_method(values).for_tilt(tilt)
        return configured.make(), asdict(configured.params)
    method = RemoteMethod(values, runner, tilt)
    return method, method.params


def offer_methods(argv: Sequence[str]) -> None:
    """Lets Hydra know methods that a command line names and only its ``runner.python`` has.

    Raises:
        ConfigError: That Python cannot be started, or does not know them either.
    """
    if SUBPROCESS not in "".join(argv) or {"-h", "--help"}.intersection(argv):
        return
    words = dict(word.split("=", 1) for word in settings_of("run", argv) if "=" in word)
    python = words.get(f"{_PREFIX}python")
    if words.get("runner") != SUBPROCESS or not python:
        return
    from hydra.core.config_store import ConfigStore

    for name in filter(None, words.get("method", "").split(",")):
        if name not in config_files("method"):
            method = RemoteMethod({"name": name}, RunnerParams(SUBPROCESS, python))
            method.close()
            ConfigStore.instance().store(group="method", name=name, node=method.params)


def remote_checks(name: str, words: Sequence[str]) -> Iterator[Check]:
    """Yields what there is to say of a method in another Python.

    Raises:
        ConfigError: That Python cannot be started or has no lodbench, or a setting is wrong.
    """
    from lodbench.harness.conformance.methods import check_answers, known_inputs, trial_settings

    reported = {key: value for key, value in option_pairs(words).items() if key.startswith(_PREFIX)}
    runner = to_params(
        {"name": SUBPROCESS, **{key.removeprefix(_PREFIX): value for key, value in reported.items()}},
        RunnerParams,
        "runner",
    )
    settings = {
        key.removeprefix("method."): value
        for key, value in option_pairs(words).items()
        if key not in reported
    }

    def make() -> RemoteMethod:
        return RemoteMethod({"name": name, **settings}, runner)

    try:
        method = make()
    except LodbenchError as error:
        # Wrong words of the command are no fault of the method.
        if isinstance(error, RunnerFault) or error.message.startswith("method."):
            raise
        yield Check("plug-in", "entry point", FAULT, error.message, error.hint)
        return
    method.close()
    yield Check("plug-in", "entry point", OK, f"{name}, in {runner.python}")
    yield Check("plug-in", "inputs", OK, known_inputs(method))
    if method.trial_params is not None:
        settings |= method.trial_params
        yield trial_settings(method.params, method.trial_params)
    yield from check_answers(make)
