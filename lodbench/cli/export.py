"""`lodbench export RUN --format ...`: a run's poses for another program."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.citymodel.scene import Scene
from lodbench.cli.parser import Parser
from lodbench.cli.verify import add_path_options, reopen_dataset
from lodbench.datasets.map_frame import MapFrame
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, DatasetError
from lodbench.harness.city import open_city
from lodbench.harness.export.export import CITY, CRS, Export, Exported, export_run, make_format
from lodbench.harness.runs.stored import read_whole_run, require_writable
from lodbench.plugins import blaming, plugin_names
from lodbench.reporting.aligned_text import count_of

_EPILOG = """\
Poses are written in the dataset's coordinates; queries without one are named, not written (in GeoJSON they
are features without a place). COLMAP, kapture and nerfstudio hold cameras, which come from the dataset.
For the Rerun viewer the city, the priors, the truth, photos and masks are written too, in the city's local
frame; `rerun FILE` opens it.
"""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    asked = _parser().parse_args(argv)
    require_writable(asked.out, [asked.run], may_be_folder=True)
    run = read_whole_run(asked.run)
    form = make_format(asked.format)
    if asked.crs is not None:
        if CRS not in form.requires:
            raise ConfigError(f"--format {asked.format} states no reference system.", "Leave --crs out.")
        MapFrame(asked.crs)  # the poses are in metres, and stay as they are
    needs = set(form.requires) - ({CRS} if asked.crs is not None else set())
    if not needs and (asked.dataset_root or asked.city_model):
        raise ConfigError(
            f"--format {asked.format} needs poses alone.", "Leave --dataset-root and --city out."
        )
    dataset = reopen_dataset(asked.run, asked.dataset_root, asked.city_model) if needs else None
    city = None
    if dataset is not None and (CITY in needs or (CRS in needs and dataset.city_model is not None)):
        city = _city_of(dataset)
    crs = asked.crs if asked.crs is not None or city is None else city.crs
    with blaming("export_formats", asked.format, "write the run"):
        done = export_run(Export(run, dataset, city, crs), form, asked.out)
    return _report(done)


def _report(done: Exported) -> int:
    """Says what was written; returns the exit code."""
    sys.stdout.write(f"{done.path}: {done.count} pose{'s' * (done.count != 1)}\n")
    if done.without_pose:
        names = ", ".join(done.without_pose[:3]) + (", ..." if len(done.without_pose) > 3 else "")
        sys.stdout.write(f"  without a pose: {count_of(len(done.without_pose), 'queries')}: {names}\n")
    return 0


def _city_of(dataset: Dataset) -> Scene:
    """Returns the city of a dataset.

    Raises:
        LodbenchError: It is not there, or cannot be read.
    """
    if dataset.city_model is None or not dataset.city_model.exists():
        raise DatasetError(
            f"The city model {dataset.city_model or 'of this run'} does not exist.",
            "Name it with --city; for geojson --crs will do.",
        )
    return open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height).scene


def _parser() -> argparse.ArgumentParser:
    parser = Parser("lodbench export", "Write a run's poses for another program.", _EPILOG)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    names = ", ".join(plugin_names("export_formats"))
    parser.add_argument("--format", required=True, metavar="FORMAT", help=names)
    parser.add_argument("--out", type=Path, metavar="PATH", help="file or folder to write (RUN/export/...)")
    parser.add_argument(
        "--crs", help="reference system that the poses are in, for formats that state one (the city model's)"
    )
    add_path_options(parser)
    return parser
