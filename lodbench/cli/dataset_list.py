"""`lodbench dataset list|download|make-demo`: what is there and what is missing; how to get it."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lodbench.cli.dataset_card import config_card
from lodbench.cli.parser import Parser
from lodbench.datasets.download import fetch
from lodbench.datasets.published.catalogue import SPECS, spec_of
from lodbench.datasets.published.layout import Survey, survey
from lodbench.errors import LodbenchError
from lodbench.execution import ProgressCallback
from lodbench.plugins import PlugIn, installed
from lodbench.reporting.aligned_text import plain_text
from lodbench.storage.paths import data_root


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser("lodbench dataset list", description="The datasets, and what is there.")
    parser.add_argument("--root", metavar="DIR", help="where to look; else LODBENCH_DATA")
    parser.add_argument("--json", action="store_true", help="print plain values instead of text")
    options = parser.parse_args(argv[1:])
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
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder to write it into")
    parser.add_argument("--num-queries", type=int, default=40, help="over both splits (40)")
    parser.add_argument("--seed", type=int, default=0, help="random seed (default: 0)")
    parser.add_argument(
        "--look", default="test", help="test (default) or train: other streets, roofs, colours"
    )
    options = parser.parse_args(argv[1:])

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
    parser.add_argument("dataset", metavar="NAME", help="as `lodbench dataset list` has it")
    parser.add_argument("--root", metavar="DIR", help="where to; else LODBENCH_DATA")
    options = parser.parse_args(argv[1:])
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
