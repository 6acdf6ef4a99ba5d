"""`lodbench dataset make-demo DIR`: write the demo dataset where it can be looked at."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.cli.parser import Parser


def main(argv: Sequence[str]) -> int:
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
