"""`lodbench dataset`: write the demo dataset, or one of your own photos and poses."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.cli.dataset_own import add_own_actions


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = argparse.ArgumentParser("lodbench dataset", description="Datasets.")
    actions = parser.add_subparsers(dest="action", required=True)
    make = actions.add_parser(
        "make-demo", help="write the demo town, its queries, photos and masks to a folder"
    )
    make.add_argument("folder", type=Path)
    make.add_argument("--num-queries", type=int, default=40)
    make.add_argument("--seed", type=int, default=0)
    make.add_argument("--look", default="test", help="test (default) or train: other streets, roofs, colours")
    make.set_defaults(make=_make_demo)
    add_own_actions(actions)
    options = parser.parse_args(argv)
    code: int = options.make(options)
    return code


def _make_demo(options: argparse.Namespace) -> int:
    from lodbench.datasets.demo.build import CITY_FILE, build_demo

    root = build_demo(options.folder, num_queries=options.num_queries, seed=options.seed, look=options.look)
    city = root / CITY_FILE
    sys.stdout.write(
        f"{root}\nTry: lodbench run dataset=folder dataset.root={root} dataset.city_model={city}\n"
    )
    return 0
