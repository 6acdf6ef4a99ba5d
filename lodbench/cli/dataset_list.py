"""`lodbench dataset list|download|card|make-demo`: what is there, how to get it, and what is known of it."""

from __future__ import annotations

import json
import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodbench.cli.parser import Parser
from lodbench.datasets.published.catalogue import SPECS, croissant_text, fetch, read_card, spec_of
from lodbench.datasets.published.layout import Survey, survey
from lodbench.errors import ConfigError, LodbenchError, nearest_names
from lodbench.execution import ProgressCallback
from lodbench.params import flag, parsed, word
from lodbench.plugins import PlugIn, config_files, installed
from lodbench.reporting.aligned_text import plain_text
from lodbench.storage import make_folder, write_text
from lodbench.storage.paths import data_root

_NAME = "as `lodbench dataset list` has it"


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


OPTIONS = {
    "dataset list": ListOptions,
    "dataset download": DownloadOptions,
    "dataset card": CardOptions,
    "dataset make-demo": DemoOptions,
}


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser("lodbench dataset list", description="The datasets, and what is there.")
    options = parsed(parser, argv[1:], ListOptions)
    found = [survey(spec, options.root, None) for spec in SPECS.values()]
    others = [plug_in for plug_in in installed("datasets") if plug_in.name not in SPECS]
    if options.json:
        sys.stdout.write(json.dumps([*map(_values, found), *map(_other_values, others)], indent=2) + "\n")
        return 0
    root = data_root() if options.root is None else Path(options.root).expanduser()
    lines = [f"published datasets in {root}"]
    for item in found:
        lines += _lines(item)
    lines += map(_other_line, others)
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    return 0


def _lines(found: Survey) -> list[str]:
    missing, spec = found.missing(), found.spec
    has_any = found.is_there
    state = "complete" if not missing else "incomplete" if has_any else "not there"
    size = f", {found.num_bytes() / 2**20:,.1f} MiB" if has_any else ""
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


def _values(found: Survey) -> dict[str, Any]:
    spec = found.spec
    return {
        "name": spec.id,
        "title": spec.title,
        "lod": spec.lod,
        "root": str(found.root),
        "splits": {split.spec.name: str(split.folder) for split in found.splits},
        "city_model": None if found.city_model is None else str(found.city_model),
        "bytes": found.num_bytes(),
        "missing": found.missing(),
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


MARKDOWN, CROISSANT = ".md", ".croissant.json"


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
                    f"{name} has no card.",
                    f"It would be conf/dataset/{name}.md, beside the dataset's YAML.",
                )
            known = [*SPECS, *config_files("dataset", MARKDOWN)]
            raise ConfigError(f"There is no card of {name!r}.", nearest_names(name, known))
        return {MARKDOWN: card.text}
    published = read_card(name)
    return {MARKDOWN: published.text, CROISSANT: croissant_text(published)}
