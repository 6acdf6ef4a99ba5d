"""`lodbench report RUN`: a self-contained HTML page of a finished run, and one of it in three dimensions."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lodbench.citymodel.imagery import Imagery, open_imagery
from lodbench.citymodel.scene import Scene
from lodbench.cli.parser import Parser
from lodbench.cli.verify import DataOptions, read_config, run_folders, verify_folder
from lodbench.errors import ConfigError
from lodbench.harness.runs.answer import FLIGHTS_FOLDER
from lodbench.harness.runs.places import flight_findings, pages_of_run, scene_of, view_of_run
from lodbench.harness.runs.report import run_report, title_of
from lodbench.harness.runs.stored import require_writable
from lodbench.params import flag, parsed, part, word
from lodbench.storage import write_text

_ABOUT = """\
Write one HTML page of a run, pictures inside, and one of each flight that a method solved as a whole; numbers
are verified on the way. Beside it PAGE_3d.html shows city and cameras in three dimensions.
"""


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """What the command is given."""

    runs: tuple[Path, ...] = word("run folders", metavar="RUN")
    out: Path | None = flag(
        None,
        "the page, of one run (report.html in the run folder); its other pages are written beside it",
        metavar="FILE",
    )
    data: DataOptions = part(DataOptions)
    imagery: Path | None = flag(None, "orthophoto (GeoTIFF, JPEG 2000) under the maps", metavar="FILE")


OPTIONS = {"": ReportOptions}


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if a run's numbers do not follow from its poses."""
    parser = Parser("lodbench report", _ABOUT)
    options = parsed(parser, argv, ReportOptions)
    folders = run_folders(options.runs, options.out)
    require_writable(options.out, folders, endings=(".html", ".htm"))
    return max(_report(folder, options) for folder in folders)


def _report(run: Path, options: ReportOptions) -> int:
    """Writes the pages of a run; returns the exit code."""
    verdict = verify_folder(run, options.data.dataset_root, options.data.city_model)
    out = options.out or run / "report.html"
    tilt = str(read_config(run)["tilt"])
    scene = scene_of(verdict)
    imagery = _imagery(options.imagery, scene)
    flights = list(flight_findings(verdict)) if scene is not None else []
    folder = run / FLIGHTS_FOLDER
    files = {
        # Into the run nothing is written that is requested elsewhere.
        name: folder / f"{name}.html" if options.out is None else out.with_name(f"{out.stem}_{name}.html")
        for name in flights
    }
    pages = {"The run": out.name, **{name: _way(file, out.parent) for name, file in files.items()}}
    view = out.with_name(f"{out.stem}_3d.html")
    view_page = "" if scene is None else view_of_run(verdict, scene, tilt, title_of(verdict), pages)
    write_text(out, run_report(verdict, tilt, scene, view.name if view_page else "", imagery))
    sys.stdout.write(f"{out}\n")
    if view_page:
        write_text(view, view_page)
        sys.stdout.write(f"{view}\n")
    if scene is not None and files:
        there = _way(view, folder if options.out is None else out.parent) if view_page else ""
        for name, page in pages_of_run(verdict, scene, tilt, there, imagery).items():
            write_text(files[name], page)
            sys.stdout.write(f"{files[name]}\n")
    for line in verdict.differences:
        sys.stderr.write(f"lodbench: {line}\n")
    return 1 if verdict.differences else 0


def _imagery(path: Path | None, scene: Scene | None) -> Imagery | None:
    """Returns what lies under the maps, or None."""
    if path is None:
        return None
    if scene is None:
        raise ConfigError(
            "--imagery needs the run's city model, which is not where it was.", "Set city=FILE."
        )
    return open_imagery(path, scene)


def _way(file: Path, folder: Path) -> str:
    """Returns the address of a file from the pages in a folder."""
    return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()
