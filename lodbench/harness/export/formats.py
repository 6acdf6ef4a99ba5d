"""The formats that come with lodbench, but for Rerun's: poses, GeoJSON, and the table of queries."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.exchange.geojson import camera_feature, nowhere_feature, write_geojson
from lodbench.datasets.exchange.kapture import write_kapture
from lodbench.datasets.exchange.lines import write_lines
from lodbench.datasets.exchange.nerfstudio import write_nerfstudio
from lodbench.datasets.exchange.photogrammetry import write_metashape, write_odm, write_pix4d
from lodbench.datasets.exchange.tum import write_tum
from lodbench.datasets.map_frame import MapFrame
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation.queries import own_failure, queries_csv
from lodbench.harness.export.export import CRS, DATASET, Export
from lodbench.harness.runs.stored import StoredRun
from lodbench.storage import write_bytes, write_text

if TYPE_CHECKING:
    import pandas as pd

_POSE_COLUMNS = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")


class Colmap:
    """COLMAP's text model."""

    file_name = "colmap"
    requires = (DATASET,)

    def write(self, export: Export, path: Path) -> None:
        """Writes a folder of cameras and images."""
        write_colmap(export.poses(), path)


class Kapture:
    """kapture's sensors and trajectories."""

    file_name = "kapture"
    requires = (DATASET,)

    def write(self, export: Export, path: Path) -> None:
        """Writes a folder of cameras and trajectories."""
        write_kapture(export.poses(), path)


class Nerfstudio:
    """nerfstudio's ``transforms.json``."""

    file_name = "transforms.json"
    requires = (DATASET,)

    def write(self, export: Export, path: Path) -> None:
        """Writes cameras and camera-to-world matrices."""
        write_nerfstudio(export.poses(), path)


class Tum:
    """The trajectories of the TUM benchmark."""

    file_name = "poses.tum"
    requires = ()

    def write(self, export: Export, path: Path) -> None:
        """Writes a line per pose, camera to world."""
        write_tum(export.poses(), path)


class VisualLocalization:
    """The lines that visuallocalization.net takes."""

    file_name = "visuallocalization.txt"
    requires = ()

    def write(self, export: Export, path: Path) -> None:
        """Writes a line per pose, world to camera."""
        write_lines(export.poses(), path)


class Metashape:
    """The reference text that Metashape imports."""

    file_name = "metashape_reference.txt"
    requires = (CRS,)

    def write(self, export: Export, path: Path) -> None:
        """Writes a line per pose: centre, yaw, pitch, roll."""
        write_metashape(export.poses(), path, export.crs)


class Pix4D:
    """Pix4D's calibrated external camera parameters."""

    file_name = "calibrated_external_camera_parameters.txt"
    requires = ()

    def write(self, export: Export, path: Path) -> None:
        """Writes a line per pose: centre, omega, phi, kappa."""
        write_pix4d(export.poses(), path)


class Odm:
    """OpenDroneMap's ``geo.txt``."""

    file_name = "geo.txt"
    requires = (CRS,)

    def write(self, export: Export, path: Path) -> None:
        """Writes the reference system, and a line per pose: centre, omega, phi, kappa."""
        write_odm(export.poses(), path, export.crs)


class GeoJson:
    """A point for each pose, and a feature without a place for each query that has none."""

    file_name = "poses.geojson"
    requires = (CRS,)

    def write(self, export: Export, path: Path) -> None:
        """Writes the features.

        Raises:
            DatasetError: Nobody knows the reference system of the poses.
        """
        if export.crs is None:
            raise DatasetError(
                "The run's poses have no reference system, so they are nowhere on a map.",
                "Name the city model with --city, or the system with --crs.",
            )
        write_geojson(_features(export.run, MapFrame(export.crs)), path)


class Csv:
    """The table of queries, with the poses as columns."""

    file_name = "queries.csv"
    requires = ()

    def write(self, export: Export, path: Path) -> None:
        """Writes the table."""
        write_text(path, queries_csv(queries_with_poses(export.run)))


class Parquet:
    """The same table, typed and small."""

    file_name = "queries.parquet"
    requires = ()

    def write(self, export: Export, path: Path) -> None:
        """Writes the table.

        Raises:
            ConfigError: pyarrow is not installed.
        """
        try:
            write_bytes(path, queries_with_poses(export.run).to_parquet(index=False))
        except ImportError as error:
            raise ConfigError("Parquet needs pyarrow.", "pip install 'lodbench[parquet]'") from error


def queries_with_poses(run: StoredRun) -> pd.DataFrame:
    """Returns the table of queries with the poses, world to camera, as ``qw qx qy qz tx ty tz``."""
    import pandas as pd

    numbers = {key: (*pose.quat_wxyz, *pose.translation) for key, pose in run.poses.items()}
    poses = pd.DataFrame.from_dict(numbers, orient="index", columns=list(_POSE_COLUMNS))
    return run.queries.join(poses)


def _features(run: StoredRun, frame: MapFrame) -> list[dict[str, Any]]:
    features = []
    for key, row in run.queries.iterrows():
        stated: dict[str, Any] = {"name": row["query"], "split": row["split"]}
        numbers = (
            ("score", "probability", "translation_error_m", "rotation_error_deg")
            if key in run.poses
            else ("score",)
        )
        stated |= {name: round(row[name], 4) for name in numbers if math.isfinite(row[name])}
        # A pose with nothing to compare it with has not failed.
        if reason := own_failure(row["failure"]):
            stated["failure"] = reason
        pose = run.poses.get(str(key))
        features.append(nowhere_feature(stated) if pose is None else camera_feature(frame, pose, stated))
    return features
