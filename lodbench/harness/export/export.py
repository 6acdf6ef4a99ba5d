"""A run's poses in the formats of other programs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.exchange.geojson import camera_feature, nowhere_feature, write_geojson
from lodbench.datasets.exchange.kapture import write_kapture
from lodbench.datasets.exchange.lines import write_lines
from lodbench.datasets.exchange.nerfstudio import write_nerfstudio
from lodbench.datasets.exchange.posed import FoundPose
from lodbench.datasets.exchange.tum import write_tum
from lodbench.datasets.map_frame import MapFrame
from lodbench.errors import ConfigError, DatasetError, nearest_names
from lodbench.evaluation.queries import queries_csv
from lodbench.geometry import Camera
from lodbench.harness.runs.stored import StoredRun
from lodbench.storage import write_text

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, slots=True)
class _Format:
    """How a format is written, and what for."""

    write: Callable[[Sequence[FoundPose], Path], None]
    file: str
    needs_cameras: bool


_WRITERS = {
    "colmap": _Format(write_colmap, "colmap", needs_cameras=True),
    "kapture": _Format(write_kapture, "kapture", needs_cameras=True),
    "nerfstudio": _Format(write_nerfstudio, "transforms.json", needs_cameras=True),
    "tum": _Format(write_tum, "poses.tum", needs_cameras=False),
    "visuallocalization": _Format(write_lines, "visuallocalization.txt", needs_cameras=False),
}
# The table of queries, with the poses as columns.
_TABLES = {"csv": "queries.csv", "parquet": "queries.parquet"}
FORMATS = (*_WRITERS, *_TABLES, "geojson", "rerun")
_POSE_COLUMNS = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written.

    Attributes:
        path: File or folder.
        count: Poses in it.
        without_pose: Names of queries that have none.
    """

    path: Path
    count: int
    without_pose: tuple[str, ...]


def needs_cameras(format_name: str) -> bool:
    """Tells whether a format holds intrinsics.

    Raises:
        ConfigError: There is no such format.
    """
    if format_name not in FORMATS:
        raise ConfigError(f"There is no format {format_name!r}.", nearest_names(format_name, FORMATS))
    return format_name in _WRITERS and _WRITERS[format_name].needs_cameras


def export_run(
    run: StoredRun,
    format_name: str,
    out: Path | None = None,
    *,
    cameras: Mapping[str, Camera] | None = None,
    crs: str | None = None,
) -> Exported:
    """Writes the poses of a run, in its dataset's coordinates.

    Args:
        run: The run.
        format_name: A name in ``FORMATS``, but for ``rerun``: see ``export_rerun``.
        out: File or folder to write; by default in the run's folder ``export``.
        cameras: Intrinsics by ``split/name``, for formats that hold them.
        crs: Reference system of the poses, for GeoJSON.

    Raises:
        LodbenchError: The format is unknown, or lacks cameras or the reference system; or a name is one
            that it cannot hold.
    """
    wants_cameras = needs_cameras(format_name)
    without = names_without_pose(run)
    if not run.poses:
        raise DatasetError(f"{run.folder} holds no poses.", "queries.csv says why each query failed.")
    if format_name == "geojson":
        path = out or run.folder / "export" / "poses.geojson"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_geojson(_features(run, crs), path)
        return Exported(path, len(run.poses), without)
    if format_name in _TABLES:
        path = out or run.folder / "export" / _TABLES[format_name]
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_table(run, path, format_name)
        return Exported(path, len(run.poses), without)
    names = run.queries["query"]
    if run.queries["split"].nunique() > 1:
        names = run.queries.index.to_series()
    known = cameras if wants_cameras and cameras else {}
    images = [
        FoundPose(name, "", run.poses[key], known.get(key)) for key, name in names.items() if key in run.poses
    ]
    path = out or run.folder / "export" / _WRITERS[format_name].file
    path.parent.mkdir(parents=True, exist_ok=True)
    _WRITERS[format_name].write(images, path)
    return Exported(path, len(images), without)


def queries_with_poses(run: StoredRun) -> pd.DataFrame:
    """Returns the table of queries with the poses, world to camera, as ``qw qx qy qz tx ty tz``."""
    import pandas as pd

    numbers = {key: (*pose.quat_wxyz, *pose.translation) for key, pose in run.poses.items()}
    poses = pd.DataFrame.from_dict(numbers, orient="index", columns=list(_POSE_COLUMNS))
    return run.queries.join(poses)


def _write_table(run: StoredRun, path: Path, format_name: str) -> None:
    frame = queries_with_poses(run)
    if format_name == "csv":
        write_text(path, queries_csv(frame))
        return
    try:
        frame.to_parquet(path, index=False)
    except ImportError as error:
        raise ConfigError("Parquet needs pyarrow.", "pip install 'lodbench[parquet]'") from error


def names_without_pose(run: StoredRun) -> tuple[str, ...]:
    """Returns the names of the queries that have no estimate."""
    return tuple(run.queries["query"][~run.queries.index.isin(run.poses)])


def _features(run: StoredRun, crs: str | None) -> list[dict[str, Any]]:
    """Returns a point for each pose, and a feature without a place for each query that has none."""
    if crs is None:
        raise DatasetError(
            "The run's poses have no reference system, so they are nowhere on a map.",
            "Name the city model with --city-model, or the system with --crs.",
        )
    frame = MapFrame(crs)
    features = []
    for key, row in run.queries.iterrows():
        stated: dict[str, Any] = {"name": row["query"], "split": row["split"]}
        numbers = ("score", "translation_error_m", "rotation_error_deg") if key in run.poses else ("score",)
        stated |= {name: round(row[name], 4) for name in numbers if math.isfinite(row[name])}
        if row["failure"]:
            stated["failure"] = row["failure"]
        pose = run.poses.get(str(key))
        features.append(nowhere_feature(stated) if pose is None else camera_feature(frame, pose, stated))
    return features
