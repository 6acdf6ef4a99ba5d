"""`lodbench export RUN --format ...`: a run's poses for another program."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lodbench.citymodel.crs import is_same_plane, require_crs
from lodbench.citymodel.scene import Scene
from lodbench.cli.parser import Parser
from lodbench.cli.verify import DataOptions, reopen_dataset, run_folders
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, DatasetError, LodbenchError
from lodbench.harness.city import open_city
from lodbench.harness.export.formats import (
    CITY,
    CRS,
    Export,
    Exported,
    ExportFormat,
    export_run,
    make_format,
    wanted_by,
)
from lodbench.harness.export.localized import is_localized, read_localized_folder
from lodbench.harness.runs.stored import StoredRun, read_whole_run, require_writable
from lodbench.params import flag, parsed, part, word
from lodbench.photos.map_frame import MapFrame
from lodbench.plugins import blaming, plugin_names
from lodbench.reporting.aligned_text import count_of

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


OPTIONS = {"": ExportOptions}


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = parsed(
        Parser("lodbench export", "Write a run's poses for another program.", _EPILOG), argv, ExportOptions
    )
    localized = [folder for folder in options.runs if is_localized(folder)]
    others = [folder for folder in options.runs if folder not in localized]
    folders = [*localized, *(run_folders(others, options.out) if others else ())]
    if options.out is not None and len(folders) > 1:
        raise ConfigError(f"--out {options.out} is one place, for {len(folders)} folders.", "Leave it out.")
    require_writable(options.out, folders, may_be_folder=True)
    form = make_format(options.format)
    _require_heard(options, form)
    for folder in folders:
        if folder in localized:
            export = _localized(options, folder, form)
        else:
            export = _opened(options, read_whole_run(folder), form)
        with blaming("export_formats", options.format, "write the run"):
            _report(export_run(export, form, options.out), form)
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


def _opened(options: ExportOptions, run: StoredRun, form: ExportFormat) -> Export:
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


def _report(done: Exported, form: ExportFormat) -> None:
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
