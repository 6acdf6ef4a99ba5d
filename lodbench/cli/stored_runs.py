"""Runs that are there: `lodbench status`, how far they are; `report`, a page; `export`, other formats."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lodbench.citymodel.crs import is_same_plane, require_crs
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.surface.orthophoto import Imagery, open_imagery
from lodbench.cli.parser import Parser, report_fault
from lodbench.cli.verify import DataOptions, read_config, reopen_dataset, run_folders, verify_folder
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, DatasetError, LodbenchError
from lodbench.execution.progress import format_seconds
from lodbench.harness.city import open_city
from lodbench.harness.export import (
    CITY,
    CRS,
    Export,
    Exported,
    ExportFormat,
    export_run,
    make_format,
    wanted_by,
)
from lodbench.harness.photo.localized import is_localized, read_localized_folder
from lodbench.harness.runs import places, report, stored
from lodbench.harness.runs.queries import FLIGHTS_FOLDER
from lodbench.params import flag, parsed, part, word
from lodbench.photos.map_frame import MapFrame
from lodbench.plugins import blaming, plugin_names
from lodbench.reporting.aligned_text import count_of, plain_text
from lodbench.storage import write_text

_ABOUT = """\
Write one HTML page of a run, pictures inside, and one of each flight that a method solved as a whole; numbers
are verified on the way. Beside it PAGE_3d.html shows city and cameras in three dimensions.
"""
_EPILOG = """\
csv is the table for people: easting, northing, height, latitude, longitude, heading, pitch, roll, standard
deviations, probability and trust of each photo. queries is the run's own table, with quaternions (world to
camera) and covariances; parquet the same, typed. geojson and gpkg (GeoPackage) are maps.

A folder that lodbench localize wrote is exported likewise: each photo is a query, with its camera as stored.

Poses are written in the dataset's coordinates; queries without one are named, not written (in tables and maps
they have no place). COLMAP, kapture and nerfstudio hold cameras, which come from the dataset.
submission is what the dataset's own benchmark takes, where it takes something (docs/datasets.md).
For the Rerun viewer the city, the priors, the truth, photos and masks are written too, in the city's local
frame; `rerun FILE` opens it. Of files that are there only earlier exports in the format are replaced.
"""


@dataclass(frozen=True, kw_only=True)
class StatusOptions:
    """What `lodbench status` is given."""

    runs: tuple[Path, ...] = word("run folders, or one that holds them", metavar="RUN")


def main_status(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 2 if a folder holds no run that can be read."""
    parser = Parser("lodbench status", description="Show the progress of runs, finished or not.")
    code = 0
    for folder in parsed(parser, argv, StatusOptions).runs:
        for run in stored.find_runs(folder):
            try:
                sys.stdout.write(describe_status(stored.read_status(run)))
            except DatasetError as fault:
                if run == folder:
                    raise
                # One that is damaged is no reason to hide those beside it.
                report_fault(fault)
                code = 2
    return code


def describe_status(status: stored.RunStatus) -> str:
    """Returns a line per run, and one per reason of failure."""
    done = f"{status.num_done} of {count_of(status.num_queries, 'queries')}"
    if status.is_finished:
        state = "finished"
    elif status.num_done == status.num_queries:
        state = "all queries done, tables not written yet"
    elif status.seconds_per_query:
        state = f"unfinished, about {format_seconds(status.seconds_left)} of work left"
    else:
        state = "unfinished"
    lines = [f"{status.folder}: {done}, {state}"]
    lines += [f"  {count} x {plain_text(reason)}" for reason, count in sorted(status.failures.items())]
    return "\n".join(lines) + "\n"


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


def main_report(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if a run's numbers do not follow from its poses."""
    parser = Parser("lodbench report", _ABOUT)
    options = parsed(parser, argv, ReportOptions)
    folders = run_folders(options.runs, options.out)
    stored.require_writable(options.out, folders, endings=(".html", ".htm"))
    return max(_report(folder, options) for folder in folders)


def _report(run: Path, options: ReportOptions) -> int:
    """Writes the pages of a run; returns the exit code."""
    verdict = verify_folder(run, options.data.dataset_root, options.data.city_model)
    out = options.out or run / "report.html"
    tilt = str(read_config(run)["tilt"])
    scene = places.scene_of(verdict)
    imagery = _imagery(options.imagery, scene)
    flights = list(places.flight_findings(verdict)) if scene is not None else []
    folder = run / FLIGHTS_FOLDER
    files = {
        # Into the run nothing is written that is requested elsewhere.
        name: folder / f"{name}.html" if options.out is None else out.with_name(f"{out.stem}_{name}.html")
        for name in flights
    }
    pages = {"The run": out.name, **{name: _way(file, out.parent) for name, file in files.items()}}
    view = out.with_name(f"{out.stem}_3d.html")
    view_page = (
        "" if scene is None else places.view_of_run(verdict, scene, tilt, report.title_of(verdict), pages)
    )
    write_text(out, report.run_report(verdict, tilt, scene, view.name if view_page else "", imagery))
    sys.stdout.write(f"{out}\n")
    if view_page:
        write_text(view, view_page)
        sys.stdout.write(f"{view}\n")
    if scene is not None and files:
        there = _way(view, folder if options.out is None else out.parent) if view_page else ""
        for name, page in places.pages_of_run(verdict, scene, tilt, there, imagery).items():
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


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """What the command is given."""

    runs: tuple[Path, ...] = word("folders of run or localize", metavar="RUN")
    format: str = flag(..., ", ".join(plugin_names("export_formats")), metavar="FORMAT")
    out: Path | None = flag(None, "file or folder to write, of one run (RUN/export/...)", metavar="PATH")
    crs: str | None = flag(
        None,
        "reference system of the poses, for formats that state one, where the run keeps none",
        sets=("crs",),
    )
    data: DataOptions = part(DataOptions)


OPTIONS = {"report": ReportOptions, "export": ExportOptions}


def main_export(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = parsed(
        Parser("lodbench export", "Write a run's poses for another program.", _EPILOG), argv, ExportOptions
    )
    localized = [folder for folder in options.runs if is_localized(folder)]
    others = [folder for folder in options.runs if folder not in localized]
    folders = [*localized, *(run_folders(others, options.out) if others else ())]
    if options.out is not None and len(folders) > 1:
        raise ConfigError(f"--out {options.out} is one place, for {len(folders)} folders.", "Leave it out.")
    stored.require_writable(options.out, folders, may_be_folder=True)
    form = make_format(options.format)
    _require_heard(options, form)
    for folder in folders:
        if folder in localized:
            export = _localized(options, folder, form)
        else:
            export = _opened(options, stored.read_whole_run(folder), form)
        with blaming("export_formats", options.format, "write the run"):
            _print_written(export_run(export, form, options.out), form)
    return 0


def _require_heard(options: ExportOptions, form: ExportFormat) -> None:
    """Checks that the format has a use for what is given."""
    if options.crs is not None:
        if CRS not in wanted_by(form):
            raise ConfigError(f"--format {options.format} states no reference system.", "Leave --crs out.")
        MapFrame(options.crs)  # the poses are in metres, and stay as they are
    if not wanted_by(form) and options.data.is_given:
        raise ConfigError(
            f"--format {options.format} needs poses alone.", "Leave --dataset-root and --city out."
        )


def _localized(options: ExportOptions, folder: Path, form: ExportFormat) -> Export:
    """Returns what `lodbench localize` wrote into a folder, with what the format takes of it."""
    if CITY in form.requires:
        raise ConfigError(
            f"--format {options.format} needs a run of a dataset, and {folder} is of lodbench localize.",
            "Make one of the photos: lodbench dataset init.",
        )
    if options.data.is_given:
        hint = "Leave --dataset-root and --city out; --crs names the system of a local frame."
        raise ConfigError(f"{folder}, of lodbench localize, has cameras and reference system itself.", hint)
    export = read_localized_folder(folder)
    return replace(export, crs=_one_system([export.crs, options.crs], options.crs))


def _opened(options: ExportOptions, run: stored.StoredRun, form: ExportFormat) -> Export:
    """Returns a run with what the format requires, or takes if it is known."""
    kept, needs = run.provenance.get("crs"), wanted_by(form)
    is_asked = CRS in needs and (kept is None or options.data.city_model is not None)
    is_placed = options.data.is_given
    dataset = city = None
    try:
        if is_placed or is_asked or needs - {CRS}:
            dataset = reopen_dataset(run.folder, options.data.dataset_root, options.data.city_model)
        if dataset is not None and (CITY in needs or (is_asked and dataset.city_model is not None)):
            city = _city_of(dataset)
    except LodbenchError:
        if is_placed or needs - {CRS} or (options.crs is None and CRS in form.requires):
            raise
    # A run of an older version keeps no system: its city and its dataset tell it, where they are there.
    reported = [
        kept,
        None if city is None else city.crs,
        None if dataset is None else dataset.crs,
        options.crs,
    ]
    return Export(run, dataset, city, _one_system(reported, options.crs) if CRS in needs else None)


def _one_system(reported: Sequence[object], crs: str | None) -> str | None:
    """Returns the reference system that poses are in, as requested or first stated; None if by nobody."""
    named = [str(name) for name in reported if name is not None]
    for other in named[1:]:
        first, second = require_crs(named[0]), require_crs(other)
        heights = {first.vertical_code, second.vertical_code} - {None}
        if not is_same_plane(named[0], other) or len(heights) > 1:
            raise DatasetError(
                f"The run's poses are in {named[0]}, not in {other}.",
                "Leave --crs out: it moves no pose, and is for runs whose system nobody knows."
                if other == crs
                else "Take the city model that the run was made with.",
            )
    return crs or (named[0] if named else None)


def _print_written(done: Exported, form: ExportFormat) -> None:
    """Says what was written, and what its angles mean where they are not those of other formats."""
    sys.stdout.write(f"{done.path}: {done.count} pose{'s' * (done.count != 1)}\n")
    if convention := getattr(form, "convention", ""):
        sys.stdout.write(f"  angles: {convention}\n")
    if done.without_pose:
        names = ", ".join(done.without_pose[:3]) + (", ..." if len(done.without_pose) > 3 else "")
        sys.stdout.write(f"  without a pose: {count_of(len(done.without_pose), 'queries')}: {names}\n")


def _city_of(dataset: Dataset) -> Scene:
    """Returns the city of a dataset."""
    if dataset.city_model is None or not dataset.city_model.exists():
        raise DatasetError(
            f"The city model {dataset.city_model or 'of this run'} does not exist.",
            "Name it with --city; for geojson --crs will do.",
        )
    return open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height).scene
