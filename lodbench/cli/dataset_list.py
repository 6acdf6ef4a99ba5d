"""`lodbench dataset list`: what is there, what is missing, how big, where to get it."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lodbench.cli.dataset_card import config_card
from lodbench.cli.parser import Parser
from lodbench.datasets.published.catalogue import SPECS
from lodbench.datasets.published.layout import Survey, survey
from lodbench.errors import LodbenchError
from lodbench.plugins import PlugIn, installed
from lodbench.reporting.safe_text import plain_text
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
