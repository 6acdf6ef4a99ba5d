"""`lodbench export RUN --format ...`: a run's poses for another program."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.citymodel.scene import Scene
from lodbench.cli.verify import add_path_options, reopen_dataset
from lodbench.datasets.query import Dataset
from lodbench.errors import DatasetError
from lodbench.harness.city import open_city
from lodbench.harness.export.export import FORMATS, Exported, export_run, needs_cameras
from lodbench.harness.export.rerun import export_rerun, require_rerun
from lodbench.harness.runs.stored import read_run

_EPILOG = """\
Poses are written in the dataset's coordinates; queries without one are named, not written (in GeoJSON they
are features without a place). COLMAP, kapture and nerfstudio hold cameras, which come from the dataset.
For the Rerun viewer the city, the priors, the truth, photos and masks are written too, in the city's local
frame; `rerun FILE` opens it.
"""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    asked = _parser().parse_args(argv)
    run = read_run(asked.run)
    cameras, crs = {}, asked.crs
    wants_cameras = needs_cameras(asked.format)
    if asked.format == "rerun":
        require_rerun()
        dataset = reopen_dataset(asked.run, asked.dataset_root, asked.city_model)
        return _report(export_rerun(run, dataset, _city_of(dataset), asked.out))
    if wants_cameras or (asked.format == "geojson" and crs is None):
        dataset = reopen_dataset(asked.run, asked.dataset_root, asked.city_model)
        cameras = {entry.key: entry.camera for entry in dataset.entries if entry.camera is not None}
        crs = _crs_of(dataset) if asked.format == "geojson" else None
    return _report(export_run(run, asked.format, asked.out, cameras=cameras, crs=crs))


def _report(done: Exported) -> int:
    """Says what was written; returns the exit code."""
    sys.stdout.write(f"{done.path}: {done.count} poses\n")
    if done.without_pose:
        names = ", ".join(done.without_pose[:3]) + (", ..." if len(done.without_pose) > 3 else "")
        sys.stdout.write(f"  {len(done.without_pose)} queries have no pose: {names}\n")
    return 0


def _crs_of(dataset: Dataset) -> str | None:
    """Returns the reference system of a dataset's poses: its city's, unless they are shifted."""
    return None if dataset.city_model is None else _city_of(dataset).crs


def _city_of(dataset: Dataset) -> Scene:
    """Returns the city of a dataset.

    Raises:
        LodbenchError: It is not there, or cannot be read.
    """
    if dataset.city_model is None or not dataset.city_model.exists():
        raise DatasetError(
            f"The city model {dataset.city_model or 'of this run'} does not exist.",
            "Name it with --city-model; for geojson --crs will do.",
        )
    return open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height).scene


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "lodbench export",
        description="Write a run's poses for another program.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    parser.add_argument("--format", required=True, metavar="FORMAT", help=", ".join(FORMATS))
    parser.add_argument("--out", type=Path, metavar="PATH", help="file or folder to write (RUN/export/...)")
    parser.add_argument("--crs", help="reference system of the poses, for geojson (the city model's)")
    add_path_options(parser)
    return parser
