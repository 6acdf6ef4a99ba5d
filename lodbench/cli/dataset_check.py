"""`lodbench dataset check|prior NAME|DIR`: what is there, what is wrong with it; its priors as a file."""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lodbench.cli.dataset_list import config_card
from lodbench.cli.parser import Parser
from lodbench.cli.settings import in_syntax_of, read_config
from lodbench.datasets.prior_sources import is_prior_text, prior_digest, prior_text
from lodbench.datasets.query import Dataset
from lodbench.datasets.registry import dataset_settings, draw_priors, make_priors, open_dataset
from lodbench.errors import ConfigError, DatasetError, Words, nearest_names
from lodbench.findings import Findings, Severity
from lodbench.harness.dataset_check import DatasetReport, SplitReport, check_dataset, prior_errors_in_words
from lodbench.params import flag, parsed, part, word
from lodbench.plugins import plugin_names
from lodbench.reporting.aligned_text import count_of, plain_text
from lodbench.storage import write_text

_EPILOG = """\
Exit code: 0 sound, 1 at least one error, 2 the data is missing (the message says what, and where to get it).
The codes are explained in docs/datasets.md.
"""
_EXAMPLES = 3


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """A dataset by its name, and where its parts lie."""

    dataset: str = word("a dataset, or a folder in the text layout", metavar="NAME|DIR")
    root: str | None = flag(
        None, "where a published dataset was unpacked", metavar="DIR", sets=("dataset.root",)
    )
    city: str | None = flag(None, "its city model", metavar="FILE", sets=("city",))
    lod: str | None = flag(None, "level of detail of the city model", sets=("lod", "dataset.lod"))


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """What `dataset check` is given."""

    of: DatasetOptions = part(DatasetOptions)
    set: tuple[str, ...] = flag((), "a setting: dataset.NAME of a run", metavar="NAME=VALUE")
    headers_only: bool = flag(False, "do not decode photos and masks")
    json: bool = flag(False, "print plain values instead of text")


@dataclass(frozen=True, kw_only=True)
class PriorsOptions:
    """What `dataset prior` is given."""

    of: DatasetOptions = part(DatasetOptions)
    kind: str = flag(
        "uniform",
        f"where they come from: {', '.join(plugin_names('priors'))}",
        metavar="KIND",
        sets=("prior",),
    )
    set: tuple[str, ...] = flag((), "a setting", metavar="KEY=VALUE")
    seed: int = flag(0, "random seed (default: 0)")
    out: Path = flag(..., "the file to write", metavar="FILE")


OPTIONS = {"dataset check": CheckOptions, "dataset prior": PriorsOptions}


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        LodbenchError: The dataset is missing or cannot be read.
    """
    parser = Parser(
        "lodbench dataset check",
        "Look at every part of a dataset: files, counts, poses, priors, photos, city model.",
        _EPILOG,
    )
    options = parsed(parser, argv[1:], CheckOptions)
    dataset, card = open_named(options.of, options.set), config_card(options.of.dataset)
    counts = card.counts if card else {}
    dataset = replace(dataset, city_hint=in_syntax_of(["dataset"], Words(dataset.city_hint)))
    report = check_dataset(dataset, with_pixels=not options.headers_only, counts=counts)
    text = json.dumps(_values(report), indent=2) + "\n" if options.json else _text(report)
    sys.stdout.write(text)
    return 1 if report.findings.has_errors() else 0


def _text(report: DatasetReport) -> str:
    dataset = report.dataset
    lines = [f"{dataset.name} in {dataset.root}", f"  city model: {report.city}"]
    for split in report.splits:
        lines += [f"  {split.name}: {line}" for line in _split_lines(split)]
    lines += ["findings", *_finding_lines(report.findings)]
    # Names come from files, indents from here.
    indents = [line[: len(line) - len(line.lstrip(" "))] for line in lines]
    return "".join(f"{indent}{plain_text(line)}\n" for indent, line in zip(indents, lines, strict=True))


def _split_lines(split: SplitReport) -> list[str]:
    whose = "its card says" if split.paper_prior is None else "the paper's tables imply"
    tables = "" if split.expected is None else f" ({whose} {split.expected})"
    lines = [
        f"{count_of(split.queries, 'queries')}, {split.truths} with a true pose{tables}, "
        f"{count_of(split.photos, 'photos')}, {count_of(split.masks, 'masks')}"
    ]
    if split.prior is None:
        there = f"{split.priors} priors; their errors are unknown without true poses"
        lines.append(there if split.priors and not split.truths else "no priors")
    else:
        paper = split.paper_prior
        beside = "" if paper is None else f" (paper: {paper[0]:g} m / {paper[1]:g} deg)"
        medians = f"{split.prior.translation_m:.2f} m / {split.prior.rotation_deg:.2f} deg"
        lines.append(f"priors off by {medians} in the median{beside}")
    if split.height_m is not None and split.off_nadir_deg is not None:
        low, mid, high = split.height_m
        flat, tilted, most = split.off_nadir_deg
        lines.append(
            f"cameras {low:.0f} to {high:.0f} m above the city's lowest point (median {mid:.0f}), "
            f"looking {flat:.0f} to {most:.0f} deg off straight down (median {tilted:.0f})"
        )
    return lines


def _finding_lines(findings: Findings) -> list[str]:
    lines = []
    for name, count in findings.counts().items():
        items = [item for item in findings.items if str(item.code) == name]
        code = items[0].code
        lines.append(f"  {name}, {code.severity.value}, {count} x: {code.meaning}")
        lines += [
            f"    {item.object_id}{f': {item.detail}' if item.detail else ''}" for item in items[:_EXAMPLES]
        ]
        lines += [f"    ... and {count - _EXAMPLES} more (--json lists all)"] if count > _EXAMPLES else []
    return lines or ["  none"]


def _values(report: DatasetReport) -> dict[str, Any]:
    return {
        "dataset": report.dataset.name,
        "root": str(report.dataset.root),
        "city_model": report.city,
        "splits": {
            split.name: {
                "queries": split.queries,
                "expected": split.expected,
                "truths": split.truths,
                "priors": split.priors,
                "photos": split.photos,
                "masks": split.masks,
                "prior_median": None if split.prior is None else list(split.prior),
                "paper_prior_median": None if split.paper_prior is None else list(split.paper_prior),
                "height_m": split.height_m,
                "off_nadir_deg": split.off_nadir_deg,
            }
            for split in report.splits
        },
        "findings": [
            {
                "code": item.code.code,
                "name": item.code.name,
                "severity": item.code.severity.value,
                "object": item.object_id,
                "detail": item.detail,
            }
            for item in report.findings.items
        ],
        "errors": sum(item.code.severity is Severity.ERROR for item in report.findings.items),
    }


def open_named(options: DatasetOptions, settings: Sequence[str] = ()) -> Dataset:
    """Returns the dataset that the options name.

    Args:
        options: Of the command.
        settings: Words ``NAME=VALUE``, as ``--set`` has them.

    Raises:
        LodbenchError: It is no name and no folder, or its data is missing or malformed.
    """
    name = options.dataset
    known = plugin_names("datasets")
    if name not in known or name == "folder":
        root = options.root if name == "folder" and options.root else name
        if not Path(root).expanduser().is_dir():
            raise ConfigError(
                f"{root} is neither a dataset nor a folder.", nearest_names(root, set(known) - {root})
            )
        values = {"name": "folder", "root": root, "city_model": options.city, "lod": options.lod}
        values = {key: value for key, value in values.items() if value is not None}
        return open_dataset(values | _settings(settings, "folder", dataset_settings("folder")))
    takes = dataset_settings(name)
    given: dict[str, Any] = {"root": options.root, "city_model": options.city, "lod": options.lod}
    values = {key: value for key, value in given.items() if value is not None}
    values |= _settings(settings, name, takes)
    refused = sorted(set(values) - takes)
    if refused:
        option = {"root": "--root", "city_model": "--city", "lod": "--lod"}[refused[0]]
        raise ConfigError(f"Dataset {name} takes no {option}.")
    return open_dataset({**(read_config("dataset", name) or {"name": name}), **values})


def _settings(words: Sequence[str], dataset: str, takes: Collection[str]) -> dict[str, Any]:
    """Returns the settings of words ``NAME=VALUE``, values read as YAML."""
    import yaml

    values: dict[str, Any] = {}
    for typed in words:
        name, equals, text = typed.removeprefix("dataset.").partition("=")
        if not equals or name not in takes:
            raise ConfigError(
                f"--set {typed}: Dataset {dataset} takes no {name}.", nearest_names(name, takes)
            )
        try:
            values[name] = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ConfigError(
                f"--set {typed} cannot be read as YAML.", "Quote it: --set \"NAME='TEXT'\""
            ) from error
    return values


_EPILOG_OF_PRIORS = """\
The file has lines `split/name qw qx qy qz tx ty tz`, world to camera. Run on it with
  lodbench run prior=file prior.path=FILE ...
Settings are those of `lodbench run prior=KIND prior.KEY=VALUE`:
  uniform  x_m y_m z_m yaw_deg pitch_deg roll_deg   half widths
  basin    range_m yaw_deg tilt_deg                 half widths
  sensor   heights takeoff_m geoid_m offset_m       how the photos' heights become the city's
"""


def main_prior(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        LodbenchError: The dataset or a setting is wrong, or the priors cannot be had.
    """
    parser = Parser("lodbench dataset prior", "Write a dataset's priors to a file.", _EPILOG_OF_PRIORS)
    options = parsed(parser, argv[1:], PriorsOptions)
    if options.out.is_dir():
        raise ConfigError(f"{options.out} is a folder.", "Name a file.")
    if options.out.exists() and not is_prior_text(options.out):
        raise ConfigError(
            f"{options.out} is there already, and no file of this command.", "Name another file: --out FILE."
        )
    priors = make_priors(options.kind, dict(map(_pair, options.set)))
    dataset = draw_priors(open_named(options.of), options.kind, priors, options.seed)
    made = sum(entry.prior is not None for entry in dataset.entries)
    if not made:
        raise DatasetError(
            f"No query of {options.of.dataset} has a prior of --kind {options.kind}: nothing is written.",
            "Another kind draws them around the truth, or reads them from the photos; see --help.",
        )
    write_text(options.out, prior_text(dataset.entries, priors.describe(), options.seed))
    lines = [f"{options.out}: {made} of {len(dataset.entries)} queries, {priors.describe()}"]
    lines += [f"digest {prior_digest(dataset.entries)}"]
    lines += [f"{split}: {words}" for split, words in prior_errors_in_words(dataset).items()]
    lines += [f"note: {in_syntax_of(['dataset', 'prior'], Words(note))}" for note in dataset.notes]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


def _pair(word: str) -> tuple[str, Any]:
    key, equals, value = word.partition("=")
    if not equals:
        raise ConfigError(f"--set {word} has no value.", "Settings are KEY=VALUE.")
    return key, value
