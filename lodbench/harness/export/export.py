"""A run's poses in the formats of other programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.exchange.geojson import camera_feature, nowhere_feature, write_geojson
from lodbench.datasets.exchange.kapture import write_kapture
from lodbench.datasets.exchange.lines import write_lines
from lodbench.datasets.exchange.nerfstudio import write_nerfstudio
from lodbench.datasets.exchange.posed import FoundPose
from lodbench.datasets.exchange.tum import write_tum
from lodbench.datasets.map_frame import MapFrame
from lodbench.errors import ConfigError, DatasetError, nearest_names
from lodbench.evaluation.rows import QueryRow
from lodbench.geometry import Camera
from lodbench.harness.runs.stored import StoredRun


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
FORMATS = (*_WRITERS, "geojson", "rerun")


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
    answered = [row for row in run.rows if row.pose is not None]
    without = tuple(row.name for row in run.rows if row.pose is None)
    if not answered:
        raise DatasetError(f"{run.folder} holds no poses.", "queries.csv says why each query failed.")
    if format_name == "geojson":
        path = out or run.folder / "export" / "poses.geojson"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_geojson(_features(run.rows, crs), path)
        return Exported(path, len(answered), without)
    with_split = len({row.split for row in run.rows}) > 1
    images = [
        _image(row, with_split, (cameras or {}).get(row.key) if wants_cameras else None) for row in answered
    ]
    path = out or run.folder / "export" / _WRITERS[format_name].file
    path.parent.mkdir(parents=True, exist_ok=True)
    _WRITERS[format_name].write(images, path)
    return Exported(path, len(images), without)


def _image(row: QueryRow, with_split: bool, camera: Camera | None) -> FoundPose:
    assert row.pose is not None  # noqa: S101 - the caller has looked
    return FoundPose(row.key if with_split else row.name, "", row.pose, camera)


def _features(rows: Sequence[QueryRow], crs: str | None) -> list[dict[str, Any]]:
    """Returns a point for each pose, and a feature without a place for each query that has none."""
    if crs is None:
        raise DatasetError(
            "The run's poses have no reference system, so they are nowhere on a map.",
            "Name the city model with --city-model, or the system with --crs.",
        )
    frame = MapFrame(crs)
    features = []
    for row in rows:
        stated: dict[str, Any] = {"name": row.name, "split": row.split}
        if row.score is not None:
            stated["score"] = round(row.score, 4)
        if row.failure:
            stated["failure"] = row.failure
        if row.pose is None:
            features.append(nowhere_feature(stated))
            continue
        if row.error is not None:
            stated["translation_error_m"] = round(row.error.translation_m, 4)
            stated["rotation_error_deg"] = round(row.error.rotation_deg, 4)
        features.append(camera_feature(frame, row.pose, stated))
    return features
