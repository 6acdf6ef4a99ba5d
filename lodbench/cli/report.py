"""`lodbench report RUN`: a self-contained HTML page of a finished run, and one of it in three dimensions."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.cli.parser import Parser
from lodbench.cli.run_folders import run_folders
from lodbench.cli.verify import add_path_options, read_config, verify_folder
from lodbench.harness.runs.answer import FLIGHTS_FOLDER
from lodbench.harness.runs.flight_pages import flight_findings, pages_of_run
from lodbench.harness.runs.places import scene_of, view_of_run
from lodbench.harness.runs.report import run_report, title_of
from lodbench.harness.runs.stored import require_writable
from lodbench.storage import write_text


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if a run's numbers do not follow from its poses."""
    parser = Parser(
        "lodbench report",
        description="Write one HTML page of a run, pictures inside, and one of each flight that a method "
        "solved as a whole; numbers are verified on the way. Beside it PAGE_3d.html shows city and cameras "
        "in three dimensions.",
    )
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="run folders")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="the page, of one run (report.html in the run folder)"
    )
    add_path_options(parser)
    options = parser.parse_args(argv)
    folders = run_folders(options.runs, options.out)
    require_writable(options.out, folders, endings=(".html", ".htm"))
    return max(_report(folder, options) for folder in folders)


def _report(run: Path, options: argparse.Namespace) -> int:
    """Writes the pages of a run; returns the exit code."""
    verdict = verify_folder(run, options.dataset_root, options.city_model)
    out = options.out or run / "report.html"
    tilt = str(read_config(run)["tilt"])
    scene = scene_of(verdict)
    view = out.with_name(f"{out.stem}_3d.html")
    view_page = "" if scene is None else view_of_run(verdict, scene, tilt, title_of(verdict))
    write_text(out, run_report(verdict, tilt, scene, view.name if view_page else ""))
    sys.stdout.write(f"{out}\n")
    if view_page:
        write_text(view, view_page)
        sys.stdout.write(f"{view}\n")
    if scene is not None and flight_findings(verdict):
        for name, page in pages_of_run(verdict, scene, tilt).items():
            write_text(run / FLIGHTS_FOLDER / f"{name}.html", page)
            sys.stdout.write(f"{run / FLIGHTS_FOLDER / f'{name}.html'}\n")
    for line in verdict.differences:
        sys.stderr.write(f"lodbench: {line}\n")
    return 1 if verdict.differences else 0
