"""`lodbench export RUN --format ...`: a run's poses for another program."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.cli.verify import add_path_options, reopen_dataset
from lodbench.datasets.query import Dataset
from lodbench.errors import DatasetError
from lodbench.harness.city import open_city
from lodbench.harness.export import FORMATS, export_run, needs_cameras
from lodbench.harness.stored import read_run

_EPILOG = """\
Poses are written in the dataset's coordinates; queries without one are named, not written (in GeoJSON they
are features without a place). COLMAP, kapture and nerfstudio hold cameras, which come from the dataset.
"""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    asked = _parser().parse_args(argv)
    run = read_run(asked.run)
    cameras, crs = {}, asked.crs
    wants_cameras = needs_cameras(asked.format)
    if wants_cameras or (asked.format == "geojson" and crs is None):
        dataset = reopen_dataset(asked.run, asked.dataset_root, asked.city_model)
        cameras = {entry.key: entry.camera for entry in dataset.entries if entry.camera is not None}
        crs = _crs_of(dataset) if asked.format == "geojson" else None
    done = export_run(run, asked.format, asked.out, cameras=cameras, crs=crs)
    sys.stdout.write(f"{done.path}: {done.count} poses\n")
    if done.without_pose:
        names = ", ".join(done.without_pose[:3]) + (", ..." if len(done.without_pose) > 3 else "")
        sys.stdout.write(f"  {len(done.without_pose)} queries have no pose: {names}\n")
    return 0


def _crs_of(dataset: Dataset) -> str | None:
    """Returns the reference system of a dataset's poses: its city's, unless they are shifted."""
    if dataset.city_model is None:
        return None
    if not dataset.city_model.exists():
        raise DatasetError(
            f"The city model {dataset.city_model} does not exist.",
            "Name it with --city-model, or give --crs.",
        )
    city = open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height)
    return city.scene.crs


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
