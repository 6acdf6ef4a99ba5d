"""`lodbench report RUN`: one self-contained HTML page of a finished run."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.cli.parser import Parser
from lodbench.cli.verify import add_path_options, read_config, verify_folder
from lodbench.harness.runs.report import run_report
from lodbench.storage import write_text


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if the run's numbers do not follow from its poses."""
    parser = Parser(
        "lodbench report",
        description="Write one HTML page of a run, pictures inside; its numbers are verified on the way.",
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the page (report.html in the run folder)")
    add_path_options(parser)
    options = parser.parse_args(argv)
    verdict = verify_folder(options.run, options.dataset_root, options.city_model)
    out = options.out or options.run / "report.html"
    write_text(out, run_report(verdict, str(read_config(options.run)["tilt"])))
    sys.stdout.write(f"{out}\n")
    for line in verdict.differences:
        sys.stderr.write(f"lodbench: {line}\n")
    return 1 if verdict.differences else 0
