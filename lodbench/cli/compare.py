"""`lodbench compare RUN ...`: finished runs side by side."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.reporting.tables import FORMATS, read_summary, tables_of


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = argparse.ArgumentParser("lodbench compare", description="Put finished runs side by side.")
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folders")
    parser.add_argument("--format", choices=sorted(FORMATS), default="text")
    options = parser.parse_args(argv)
    tables = tables_of([read_summary(folder) for folder in options.runs])
    sys.stdout.write("\n".join(FORMATS[options.format](table) for table in tables))
    return 0
