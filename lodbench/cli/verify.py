"""`lodbench evaluate` scores anybody's pose file; `lodbench verify` checks a run's numbers by its poses."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from yaml import AliasToken, scan, tokens

from lodbench.cli.hydra_app import plain, run_hydra, section
from lodbench.cli.parser import Parser
from lodbench.cli.run import data_identity, with_date, with_masks, with_prior, with_source
from lodbench.datasets.folder import select_splits
from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.datasets.query import Dataset
from lodbench.datasets.registry import dataset_opener, dataset_settings, open_dataset
from lodbench.errors import ConfigError, DatasetError, LodbenchError
from lodbench.evaluation.metrics import has_truth, protocol_named
from lodbench.evaluation.predictions import (
    Prediction,
    evaluate,
    match_poses,
    pose_numbers,
    suspect_convention,
)
from lodbench.geometry import Pose
from lodbench.harness.city import open_city
from lodbench.harness.runs import gallery, requirements, stored
from lodbench.harness.runs.artefacts import Result, is_own, summary_of, without_paths, write_artefacts
from lodbench.harness.runs.inputs import chosen_entries, queries_digest
from lodbench.harness.runs.queries import Preparation, prior_of
from lodbench.harness.runs.verify import Verdict, verify_run
from lodbench.params import flag, parsed, part, to_params, word
from lodbench.rendering import make_renderer
from lodbench.reporting.aligned_text import count_of, plain_text
from lodbench.reporting.tables import format_text, tables_of
from lodbench.segmentation import Segmenter
from lodbench.segmentation.protocol import make_segmenter
from lodbench.storage import digest_of, make_folder, remove_leftovers
from lodbench.storage.paths import path_name

NO_POSE = "no pose in the pose file"
# What a pose file does not say about how it was made.
UNSTATED = "unstated"
_EPILOG = """\
Exit code: 0 all numbers are consistent, 1 they are not (one line per difference), 2 the run cannot be read.
If the dataset is missing, only summary.json is compared with queries.csv, a weaker check.
"""
_NOT_OWN = (
    "the run was made elsewhere or by an older version, so no path that it names was opened; "
    "--dataset-root and --city name them"
)
# A run's configuration has some kilobytes, and a few levels.
_MAX_CONFIG, _MAX_DEPTH = 1_000_000, 50
_OPENING = (
    tokens.BlockMappingStartToken,
    tokens.BlockSequenceStartToken,
    tokens.FlowMappingStartToken,
    tokens.FlowSequenceStartToken,
)
CONFIG_FILE = "config.yaml"


@dataclass(frozen=True, slots=True)
class EvaluateOptions:
    """The settings of the command that belong to no part of it; see ``EvaluateSettings``."""

    poses: str
    format: str = "auto"
    method_name: str | None = None
    tilt: str = "prior"
    split: list[str] = field(default_factory=list)
    limit: int | None = None


def main_evaluate(argv: Sequence[str]) -> int:
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


@dataclass(frozen=True, slots=True)
class EvaluateSettings:
    """What is scored, and under which name."""

    poses: Path  # the pose file, or folder
    runs_root: Path  # folder that run folders are made in
    # The resolved configuration that defines the result; this module adds what the file is.
    config: dict[str, Any] = field(default_factory=dict)
    format: str = "auto"  # ``auto``, or an entry point under ``lodbench.pose_formats``
    method_name: str = ""  # name to report; the file's own if empty
    tilt: str = "prior"  # which pitch and roll the method had, as its author says: ``prior`` or ``truth``
    splits: tuple[str, ...] = ()  # splits to score; empty for all
    limit: int | None = None  # at most this many queries per split, or None


def evaluate_poses(dataset: Dataset, settings: EvaluateSettings) -> Result:
    """Returns the scored poses of a file; a query without a pose is a failure and counts.

    Raises:
        LodbenchError: A fault of the file, the dataset or the settings; nothing is scored then.
    """
    name = path_name("method", settings.method_name or re.sub(r"[^\w.+-]+", "_", settings.poses.stem))
    requirements.require_choices(settings.tilt, settings.limit)
    splits = select_splits(dataset, settings.splits)
    entries = chosen_entries(dataset, splits, settings.limit)
    known = {word for entry in dataset.entries for word in (entry.name, entry.key)}
    kind, listed = read_pose_file(settings.poses, settings.format, known)
    poses, moved = brought(listed, dataset.crs)
    # Matched with all queries: a name of another split is no unknown name.
    matched = match_poses(poses, dataset.entries, kind)
    suspicion = suspect_convention(matched.poses, _references(dataset), kind != "c2w")
    notes = moved + matched.notes + ((suspicion,) if suspicion else ())
    inputs = {
        "queries": queries_digest(dataset, entries),
        "poses": digest_of([[pose.name, pose_numbers(pose.pose)] for pose in poses]),
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
    return gallery.write_overlays(result, preparation, renderer)


def _references(dataset: Dataset) -> dict[str, Pose]:
    """Returns where the poses should about be: at the truth, or else at the prior."""
    priors = {entry.key: entry.prior for entry in dataset.entries if entry.prior is not None}
    return {**priors, **dataset.truth}


def _prediction(pose: Pose | None) -> Prediction:
    return Prediction(pose, NO_POSE if pose is None else "")


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """Where the data of a run lies now."""

    dataset_root: str | None = flag(None, "where the dataset lies now", metavar="DIR", sets=("dataset.root",))
    city_model: str | None = flag(
        None, "where the city model lies now", "--city", metavar="FILE", old="--city-model", sets=("city",)
    )

    @property
    def is_given(self) -> bool:
        """Returns whether either is named."""
        return bool(self.dataset_root or self.city_model)


@dataclass(frozen=True, kw_only=True)
class VerifyOptions:
    """What the command is given."""

    run: Path = word("run folder", metavar="RUN")
    data: DataOptions = part(DataOptions)


OPTIONS = {"verify": VerifyOptions}


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser("lodbench verify", "Score a run again from its stored poses and compare.", _EPILOG)
    options = parsed(parser, argv, VerifyOptions)
    verdict = verify_folder(options.run, options.data.dataset_root, options.data.city_model)
    sys.stdout.write(describe(verdict))
    return 1 if verdict.differences else 0


def verify_folder(folder: Path, dataset_root: str | None = None, city_model: str | None = None) -> Verdict:
    """Returns the verdict on a run folder, its dataset opened from where it was, or is said to be, now.

    Raises:
        LodbenchError: The run cannot be read, or the data at a given place cannot.
    """
    config = read_config(folder)
    _require_useful(config, dataset_root, city_model)
    opened = _opened(folder, config, dataset_root, city_model)
    try:
        dataset = _reopen(folder, opened.config, opened.root, opened.city_if_there())
    except LodbenchError:
        if dataset_root or city_model:
            raise
        dataset = None
    segmenter, unseen = None, []
    if "masks" in stored.read_run(folder).summary["dataset"]:
        if opened.config["segmenter"] == config["segmenter"]:
            segmenter, _ = make_segmenter(config["segmenter"]["name"], config["segmenter"])
        else:
            unseen = ["the masks were not compared: they depend on a path that the run names"]
    verdict = verify_run(folder, config, dataset, segmenter, has_own_priors=_keeps_priors(config))
    is_whole = dataset is not None and dataset.city_model is not None and opened.config == config
    unseen += [] if opened.is_own or is_whole else [_NOT_OWN]
    return replace(verdict, notes=(*verdict.notes, *unseen))


def reopen_dataset(folder: Path, dataset_root: str | None = None, city_model: str | None = None) -> Dataset:
    """Returns the dataset of a run, from where it was, or is said to be, now.

    Raises:
        LodbenchError: The run or the data cannot be read, or only a stranger's run names their place.
    """
    config = read_config(folder)
    _require_useful(config, dataset_root, city_model)
    opened = _opened(folder, config, dataset_root, city_model)
    try:
        return _reopen(folder, opened.config, opened.root, opened.city)
    except LodbenchError as error:
        if opened.is_own or dataset_root:
            raise
        raise DatasetError(f"{folder} names paths that were not opened.", f"{_NOT_OWN}.") from error


def _require_useful(config: dict[str, Any], root: str | None, city: str | None) -> None:
    """Checks the places that are said to be the data's now."""
    known = dataset_settings(config["dataset"]["name"])
    for option, path, setting in (("--dataset-root", root, "root"), ("--city", city, "city_model")):
        if path is not None and setting not in known:
            name = config["dataset"]["name"]
            raise ConfigError(
                f"{option} is not used with dataset={name}, which is built in.", "Leave it out."
            )
        if path is not None and not Path(path).exists():
            raise DatasetError(f"{path} does not exist.", f"Check the path after {option}.")


@dataclass(frozen=True, slots=True)
class _Opened:
    """What may be opened for a run."""

    config: dict[str, Any]
    root: str | None
    city: str | None
    is_own: bool

    def city_if_there(self) -> str | None:
        """Returns the city's place; None where it is gone, which ``verify_run`` notes."""
        return self.city if self.city is not None and Path(self.city).exists() else None


def _opened(folder: Path, config: dict[str, Any], root: str | None, city: str | None) -> _Opened:
    provenance = stored.read_run(folder).provenance
    if not is_own(provenance, config):
        return _Opened(without_paths(config), root, city, False)
    return _Opened(config, root or provenance["dataset_root"], city or provenance["city_model"], True)


def read_config(folder: Path) -> dict[str, Any]:
    """Returns the configuration of a run folder as JSON values.

    Raises:
        DatasetError: There is none, it is not one of a run, or the run is not finished.
    """
    path = folder / CONFIG_FILE
    # The one is there from a run's start, the other from its end.
    if (folder / stored.PLAN_FILE).is_file() and not (folder / "summary.json").exists():
        raise DatasetError(
            f"The run {folder} is not finished.", "The same `lodbench run` command as before goes on with it."
        )
    if not path.is_file():
        raise _no_run(folder)
    try:
        text = path.read_text(encoding="utf-8")
        _require_plain(text)
        config = OmegaConf.to_container(OmegaConf.create(text))
    except Exception as error:  # the YAML reader's faults share no base with OmegaConf's
        raise DatasetError(f"{path} is not a readable configuration.", "Name a run folder.") from error
    if not isinstance(config, dict) or not {"dataset", "method", "tilt"} <= set(config):
        raise DatasetError(f"{path} is not the configuration of a run.")
    return cast("dict[str, Any]", config)


def _require_plain(text: str) -> None:
    """Makes sure that a YAML text takes no longer to read than what a run writes."""
    depth = 0
    for token in scan(text) if len(text) <= _MAX_CONFIG else [AliasToken("", None, None)]:
        depth += isinstance(token, _OPENING)
        depth -= isinstance(
            token, tokens.FlowSequenceEndToken | tokens.FlowMappingEndToken | tokens.BlockEndToken
        )
        if isinstance(token, AliasToken) or depth > _MAX_DEPTH:
            raise ValueError("no run writes that")


def _no_run(folder: Path) -> DatasetError:
    """Returns the fault of a folder that holds no run itself; its hint names one below it."""
    if not folder.exists():
        return DatasetError(f"{folder} does not exist.", "Name a run folder.")
    if not folder.is_dir():
        return DatasetError(f"{folder} is not a folder.", "Name a run folder.")
    # runs/<dataset>/<method>/<digest>, from any of them; whole disks are not looked through.
    below = (path for depth in (1, 2, 3) for path in folder.glob(f"{'*/' * depth}{CONFIG_FILE}"))
    run = next((each.parent for each in below if (each.parent / "summary.json").is_file()), None)
    hint = "Name a run folder." if run is None else f"Name a run folder, as {shlex.quote(str(run))}"
    return DatasetError(f"{folder} is not a run folder: it holds no {CONFIG_FILE}.", hint)


def describe(verdict: Verdict) -> str:
    """Returns the report: a line per difference, then how far the check went."""
    lines = list(verdict.differences)
    if verdict.is_weak:
        lines.append(
            "weaker check: dataset not at its former path, so summary.json was compared with queries.csv "
            "only; give its path with --dataset-root"
        )
    lines += [f"note: {note}" for note in verdict.notes]
    if verdict.unknown:
        names = plain_text(", ".join(verdict.unknown))
        lines.append(f"note: metrics of packages not installed then or now, not compared: {names}")
    count = len(verdict.differences)
    queries = len(verdict.stored.queries)
    if count:
        lines.append(f"{verdict.stored.folder}: {count} difference{'s' * (count > 1)}")
    else:
        basis = (
            "with queries.csv (poses not recomputed)"
            if verdict.is_weak
            else "with poses and ground truth"
            if has_truth(verdict.stored.queries).any()
            else "with their poses; no ground truth to check"
        )
        lines.append(f"{verdict.stored.folder}: {count_of(queries, 'queries')} consistent {basis}")
    return "\n".join(lines) + "\n"


def _reopen(folder: Path, config: dict[str, Any], root: str | None, city: str | None) -> Dataset:
    """Returns the dataset of a run; one that is built in takes no paths."""
    section = dict(config["dataset"])
    known = dataset_settings(section["name"])
    paths = {"root": root, "city_model": city}
    section.update({key: path for key, path in paths.items() if key in known})
    dataset = with_source(open_dataset(section), config["source"])
    dataset = with_masks(dataset, config.get("segmenter", {}))
    prior = config.get("prior", {"name": "file"})
    if _keeps_priors(config):
        prior = {"name": "file", "path": str(folder / "priors.txt")}
    drawn, _ = with_prior(dataset, prior, config.get("seed", 0))
    return drawn


def _keeps_priors(config: dict[str, Any]) -> bool:
    """Tells whether only the run's own folder has its priors: they came from photos or another file."""
    prior = config.get("prior", {})
    return prior.get("name") == "sensor" or "content" in prior


def run_folders(named: Sequence[Path], out: Path | None = None) -> list[Path]:
    """Returns the folders of finished runs among several, in order; says which others are passed over.

    One alone, what is not there, and all where none holds a run are returned as they are: whoever reads them
    says what is wrong.

    Args:
        named: Folders and files.
        out: ``--out`` of a command that writes one file per run; None where it is not given, or is of all.

    Raises:
        ConfigError: There is one ``--out`` for several runs.
    """
    others = [path for path in named if path.exists() and not (path / CONFIG_FILE).is_file()]
    runs = [path for path in named if path not in others]
    if not runs:
        return list(named)
    for path in others:
        sys.stderr.write(f"lodbench: skipped, not a finished run: {path}\n")
    if out is not None and len(runs) > 1:
        raise ConfigError(f"--out {out} is one place, and there are {len(runs)} runs.", "Leave --out out.")
    return runs
