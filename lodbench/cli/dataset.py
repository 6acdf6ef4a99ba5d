"""`lodbench dataset list|download|card|make-demo|check|prior`: what there is, how to get it, is it sound."""

from __future__ import annotations

import json
import re
import shlex
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.cli.parser import Parser
from lodbench.cli.settings import in_syntax_of, read_config
from lodbench.datasets.prior_sources import is_prior_text, prior_digest, prior_text
from lodbench.datasets.published.catalogue import SPECS, croissant_text, fetch, read_card, spec_of
from lodbench.datasets.published.layout import Survey, survey
from lodbench.datasets.query import Dataset
from lodbench.datasets.registry import dataset_settings, draw_priors, make_priors, open_dataset
from lodbench.errors import ConfigError, DatasetError, LodbenchError, Words, nearest_names
from lodbench.execution import ProgressCallback
from lodbench.findings import Findings, Severity
from lodbench.params import flag, parsed, part, word
from lodbench.plugins import PlugIn, config_files, installed, plugin_names
from lodbench.reporting.aligned_text import count_of, plain_text
from lodbench.storage import make_folder, write_text
from lodbench.storage.paths import data_root

if TYPE_CHECKING:
    from lodbench.harness.dataset_check import DatasetReport, SplitReport

_NAME = "as `lodbench dataset list` has it"
MARKDOWN, CROISSANT = ".md", ".croissant.json"
_EPILOG = """\
Exit code: 0 sound, 1 at least one error, 2 the data is missing (the message says what, and where to get it).
The codes are explained in docs/datasets.md.
"""
_EXAMPLES = 3
_EPILOG_OF_PRIORS = """\
The file has lines `split/name qw qx qy qz tx ty tz`, world to camera. Run on it with
  lodbench run prior=file prior.path=FILE ...
Settings are those of `lodbench run prior=KIND prior.KEY=VALUE`:
  uniform  x_m y_m z_m yaw_deg pitch_deg roll_deg   half widths
  basin    range_m yaw_deg tilt_deg                 half widths
  sensor   heights takeoff_m geoid_m offset_m       how the photos' heights become the city's
"""


@dataclass(frozen=True, kw_only=True)
class ListOptions:
    """What `dataset list` is given."""

    root: str | None = flag(None, "where to look; else LODBENCH_DATA", metavar="DIR")
    json: bool = flag(False, "print plain values instead of text")


@dataclass(frozen=True, kw_only=True)
class DownloadOptions:
    """What `dataset download` is given."""

    dataset: str = word(_NAME, metavar="NAME")
    root: str | None = flag(None, "where to; else LODBENCH_DATA", metavar="DIR")


@dataclass(frozen=True, kw_only=True)
class CardOptions:
    """What `dataset card` is given."""

    dataset: str = word(_NAME, metavar="NAME")
    out: Path | None = flag(None, "write NAME.md, and NAME.croissant.json for a download", metavar="DIR")
    croissant: bool = flag(False, "print the JSON-LD instead of Markdown")


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """What `dataset make-demo` is given."""

    folder: Path = word("folder to write it into", metavar="DIR")
    num_queries: int = flag(40, "over both splits (40)")
    seed: int = flag(0, "random seed (default: 0)")
    look: str = flag("test", "test (default) or train: other streets, roofs, colours")


def main_list(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser("lodbench dataset list", description="The datasets, and what is there.")
    options = parsed(parser, argv[1:], ListOptions)
    inventories = [survey(spec, options.root, None) for spec in SPECS.values()]
    others = [plug_in for plug_in in installed("datasets") if plug_in.name not in SPECS]
    if options.json:
        values = [*map(_survey_values, inventories), *map(_other_values, others)]
        sys.stdout.write(json.dumps(values, indent=2) + "\n")
        return 0
    root = data_root() if options.root is None else Path(options.root).expanduser()
    lines = [f"published datasets in {root}"]
    for item in inventories:
        lines += _lines(item)
    lines += map(_other_line, others)
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    return 0


def _lines(surveyed: Survey) -> list[str]:
    missing, spec = surveyed.missing(), surveyed.spec
    has_any = surveyed.is_there
    state = "complete" if not missing else "incomplete" if has_any else "not there"
    size = f", {surveyed.num_bytes() / 2**20:,.1f} MiB" if has_any else ""
    lines = [f"{spec.id:<13} {state}{size}: {spec.title}, {spec.map_words}"]
    if missing:
        lines += [f"  missing  {line}" for line in missing] if has_any else []
        lines += [f"  get      {host.what}: {host.url}" for host in spec.hosts]
    return lines


def _other_line(plug_in: PlugIn) -> str:
    values = _other_values(plug_in)
    words = f"broken: {values['fault']}" if values["fault"] else values["title"]
    origin = "" if plug_in.is_ours else f" (package {plug_in.package})"
    return plain_text(f"{plug_in.name:<13} {words}{origin}")


def _other_values(plug_in: PlugIn) -> dict[str, Any]:
    """Returns what its card says of a dataset that is no published one."""
    card, fault = None, plug_in.fault
    try:
        card = config_card(plug_in.name)
        if not plug_in.is_ours:  # a package of others may be broken
            plug_in.load()
    except LodbenchError as error:
        fault = error.message
    title = card.title if card else "has no card"
    return {"name": plug_in.name, "title": title, "package": plug_in.package, "fault": fault}


def _survey_values(inventory: Survey) -> dict[str, Any]:
    spec = inventory.spec
    return {
        "name": spec.id,
        "title": spec.title,
        "lod": spec.lod,
        "root": str(inventory.root),
        "splits": {split.spec.name: str(split.folder) for split in inventory.splits},
        "city_model": None if inventory.city_model is None else str(inventory.city_model),
        "bytes": inventory.num_bytes(),
        "missing": inventory.missing(),
        "sources": [{"what": h.what, "url": h.url, "how": h.how} for h in spec.hosts],
    }


def main_demo(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser("lodbench dataset make-demo", description="Write the demo dataset.")
    options = parsed(parser, argv[1:], DemoOptions)

    from lodbench.synthesis.town.build import CITY_FILE, build_demo

    root = build_demo(options.folder, num_queries=options.num_queries, seed=options.seed, look=options.look)
    city = root / CITY_FILE
    words = shlex.join(["dataset=folder", f"dataset.root={root}", f"city={city}"])
    sys.stdout.write(f"{root}\nTry: lodbench run {words}\n")
    return 0


def main_download(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if nothing of the dataset can be fetched.

    Raises:
        LodbenchError: The dataset is unknown, or a file cannot be fetched.
    """
    parser = Parser(
        "lodbench dataset download",
        description="Fetch the files of a published dataset that have a stable address.",
    )
    options = parsed(parser, argv[1:], DownloadOptions)
    spec = spec_of(options.dataset)
    root = data_root() if options.root is None else Path(options.root).expanduser()
    lines = []
    for download in spec.downloads:
        with ProgressCallback(f"fetching {Path(download.path).name}", "MB", 1_000_000) as progress:
            path, is_new = fetch(download, root, progress)
        lines.append(f"{path}: {'fetched' if is_new else 'there already'}, SHA-256 as published")
    if not spec.downloads:
        lines.append(f"{spec.title} cannot be downloaded automatically: nothing was fetched.")
    missing = survey(spec, str(root), None).missing()
    lines += [f"missing: {line}" for line in missing]
    if missing:
        lines += [f"by hand: {host.what}: {host.url}\n         {host.how}" for host in spec.hosts]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0 if spec.downloads else 1


def main_card(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        ConfigError: There is no card of that name.
    """
    parser = Parser("lodbench dataset card", description="Print or write a dataset's card.")
    options = parsed(parser, argv[1:], CardOptions)
    texts = _card_texts(options.dataset)
    if options.out is None:
        if options.croissant and CROISSANT not in texts:
            raise ConfigError(
                f"{options.dataset} has no Croissant: that describes files to download.",
                "It is made on your machine; the card without --croissant says how.",
            )
        sys.stdout.write(texts[CROISSANT if options.croissant else MARKDOWN])
        return 0
    make_folder(options.out)
    for ending, text in texts.items():
        path = options.out / f"{options.dataset}{ending}"
        write_text(path, text)
        sys.stdout.write(f"{path}\n")
    return 0


@dataclass(frozen=True, slots=True)
class ConfigCard:
    """The card of a dataset that is no published one: ``dataset/NAME.md`` beside its configuration."""

    text: str
    title: str
    counts: dict[str, int]


def config_card(name: str) -> ConfigCard | None:
    """Returns the card beside a dataset's configuration; None if it has none.

    Raises:
        ConfigError: Its head is no YAML.
    """
    import yaml

    file = config_files("dataset", MARKDOWN).get(name)
    if file is None:
        return None
    text = re.sub(r"\A<!--.*?-->\s*", "", file.read_text(encoding="utf-8"))
    head = re.match(r"---\n(.*?)\n---\n", text, re.DOTALL)
    try:
        values: Any = yaml.safe_load(head[1]) if head else {}
        splits = values.get("splits") or {}
        counts = {str(split): int(count) for split, count in splits.items() if count is not None}
        return ConfigCard(text, str(values.get("title", name)), counts)
    except Exception as error:  # a head may be anything
        raise ConfigError(f"The head of {file} cannot be read: {str(error).splitlines()[0]}") from error


def _card_texts(name: str) -> dict[str, str]:
    """Returns the files of a card by their endings."""
    if name not in SPECS:
        card = config_card(name)
        if card is None:
            if name in config_files("dataset"):
                raise ConfigError(
                    f"{name} has no card.", f"It would be conf/dataset/{name}.md, beside the dataset's YAML."
                )
            known = [*SPECS, *config_files("dataset", MARKDOWN)]
            raise ConfigError(f"There is no card of {name!r}.", nearest_names(name, known))
        return {MARKDOWN: card.text}
    published = read_card(name)
    return {MARKDOWN: published.text, CROISSANT: croissant_text(published)}


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


OPTIONS = {
    "dataset list": ListOptions,
    "dataset download": DownloadOptions,
    "dataset card": CardOptions,
    "dataset make-demo": DemoOptions,
    "dataset check": CheckOptions,
    "dataset prior": PriorsOptions,
}


def main_check(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        LodbenchError: The dataset is missing or cannot be read.
    """
    from lodbench.harness.dataset_check import check_dataset

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
    text = json.dumps(_report_values(report), indent=2) + "\n" if options.json else _text(report)
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


def _report_values(report: DatasetReport) -> dict[str, Any]:
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


def main_prior(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        LodbenchError: The dataset or a setting is wrong, or the priors cannot be had.
    """
    from lodbench.harness.dataset_check import prior_errors_in_words

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
