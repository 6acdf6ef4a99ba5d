"""`lodbench city info|check FILE`: look into a city model."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if `check` finds an error."""
    parser = argparse.ArgumentParser("lodbench city", description="Look into a city model.")
    actions = parser.add_subparsers(dest="action", required=True)
    for name, help_ in (
        ("info", "format, CRS, levels of detail, counts, findings"),
        ("check", "the findings, exit code 1 if any lost data"),
    ):
        action = actions.add_parser(name, help=help_)
        action.add_argument("file", type=Path)
        action.add_argument("--crs", help="CRS of the coordinates, where the file says none or a wrong one")
        action.add_argument("--json", action="store_true", help="for machines")
    options = parser.parse_args(argv)

    from lodbench.citymodel import city_info, read_city_model

    model = read_city_model(options.file, crs=options.crs)
    info = city_info(model)
    if options.action == "check":
        info = {"findings": info["findings"]}
    text = json.dumps(info, indent=2, ensure_ascii=False) if options.json else "\n".join(_lines(info))
    sys.stdout.write(text + "\n")
    return 1 if options.action == "check" and model.findings.has_errors() else 0


def _lines(value: dict[str, Any], indent: str = "") -> list[str]:
    """Returns nested values as indented `name: value` lines."""
    lines = []
    for key, item in value.items():
        if isinstance(item, dict):
            lines += [f"{indent}{key}:" + ("" if item else " none"), *_lines(item, indent + "  ")]
        else:
            lines.append(f"{indent}{key}: {item}")
    return lines
