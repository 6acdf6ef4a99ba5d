"""The formats that come with lodbench, but for Rerun's: poses, maps, and tables."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from lodbench.citymodel.source import is_own_geopackage
from lodbench.datasets.exchange.colmap import require_no_binary, write_colmap
from lodbench.datasets.exchange.geojson import camera_feature, nowhere_feature, write_geojson
from lodbench.datasets.exchange.geopackage import write_geopackage
from lodbench.datasets.exchange.kapture import write_kapture
from lodbench.datasets.exchange.lines import write_lines
from lodbench.datasets.exchange.nerfstudio import write_nerfstudio
from lodbench.datasets.exchange.photogrammetry import write_metashape, write_odm, write_pix4d
from lodbench.datasets.exchange.tum import write_tum
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation.queries import own_failure, queries_csv
from lodbench.harness.export.export import CRS, DATASET, Export
from lodbench.harness.runs.stored import StoredRun
from lodbench.harness.runs.survey import survey_csv
from lodbench.photos.map_frame import MapFrame
from lodbench.reporting.answers import trust_of
from lodbench.storage import write_bytes, write_text

if TYPE_CHECKING:
    import pandas as pd

_POSE_COLUMNS = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")


class _Poses:
    """A format of poses alone, written by a function of poses and path."""

    requires: tuple[str, ...] = ()
    writer: ClassVar[Any]

    def write(self, export: Export, path: Path) -> None:
        """Writes the file or folder."""
        type(self).writer(export.poses(), path)


class Colmap(_Poses):
    """COLMAP's text model: a folder of cameras and images."""

    file_name, requires, writer = "colmap", (DATASET,), write_colmap
    require_room = staticmethod(require_no_binary)


class Kapture(_Poses):
    """kapture's folder of sensors and trajectories."""

    file_name, requires, writer = "kapture", (DATASET,), write_kapture


class Nerfstudio(_Poses):
    """nerfstudio's ``transforms.json``: cameras and camera-to-world matrices."""

    file_name, requires, writer = "transforms.json", (DATASET,), write_nerfstudio


class Tum(_Poses):
    """The trajectories of the TUM benchmark: a line per pose, camera to world."""

    file_name, writer = "poses.tum", write_tum


class VisualLocalization(_Poses):
    """The lines that visuallocalization.net takes: a pose each, world to camera."""

    file_name, writer = "visuallocalization.txt", write_lines


class Pix4D(_Poses):
    """Pix4D's calibrated external camera parameters: centre, omega, phi, kappa."""

    file_name, writer = "calibrated_external_camera_parameters.txt", write_pix4d


class Metashape:
    """The reference text that Metashape imports: centre, yaw, pitch, roll."""

    file_name = "metashape_reference.txt"
    requires = (CRS,)

    def write(self, export: Export, path: Path) -> None:
        """Writes a line per pose."""
        write_metashape(export.poses(), path, export.crs)


class Odm:
    """OpenDroneMap's ``geo.txt``: centre, omega, phi, kappa."""

    file_name = "geo.txt"
    requires = (CRS,)

    def write(self, export: Export, path: Path) -> None:
        """Writes the reference system, and a line per pose."""
        write_odm(export.poses(), path, export.crs)


class GeoJson:
    """A point for each pose, and a feature without a place for each query that has none."""

    file_name = "poses.geojson"
    requires = (CRS,)
    writer: ClassVar[Any] = write_geojson

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
        type(self).writer(_features(export.run, MapFrame(export.crs)), path)


class GeoPackage(GeoJson):
    """The same features as a layer of a GeoPackage."""

    file_name, writer = "poses.gpkg", write_geopackage

    def require_room(self, path: Path) -> None:
        """Makes sure that no other GeoPackage is replaced.

        Raises:
            ConfigError: One would be.
        """
        if path.is_file() and not is_own_geopackage(path):
            raise ConfigError(f"{path} is there already, and is no such export.", "Name another with --out.")


class Csv:
    """The surveyor's table: coordinates, angles, standard deviations, probability and trust of each query."""

    file_name = "poses.csv"
    requires = ()
    optional = (CRS,)

    def write(self, export: Export, path: Path) -> None:
        """Writes a row per query, without latitude and longitude where nobody knows the reference system."""
        write_text(path, survey_csv(export.run, export.crs))


class Queries:
    """The table of queries as the run has it, with quaternions, translations and covariances."""

    file_name = "queries.csv"
    requires = ()

    def write(self, export: Export, path: Path) -> None:
        """Writes the table."""
        write_text(path, queries_csv(queries_with_poses(export.run)))


class Submission:
    """What the dataset's own benchmark takes, in its coordinates and names."""

    file_name = "submission.txt"
    requires = (DATASET,)

    def write(self, export: Export, path: Path) -> None:
        """Writes it, of all queries of the run.

        Raises:
            DatasetError: The dataset has no such format.
        """
        dataset, run = export.dataset, export.run
        if dataset is None or dataset.submission is None:
            name = run.summary["dataset"]["name"]
            raise DatasetError(
                f"{name} has no format of submissions that is known.", "--format csv holds the poses."
            )
        write_text(path, dataset.submission({str(key): run.poses.get(str(key)) for key in run.queries.index}))


class Parquet:
    """The table of ``Queries``, typed and small."""

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
    """Returns the table of queries with the poses, world to camera, as ``qw qx qy qz tx ty tz``.

    An answer with nothing to compare it with has not failed.
    """
    import pandas as pd

    numbers = {key: (*pose.quat_wxyz, *pose.translation) for key, pose in run.poses.items()}
    poses = pd.DataFrame.from_dict(numbers, orient="index", columns=list(_POSE_COLUMNS))
    return run.queries.assign(failure=run.queries["failure"].map(own_failure)).join(poses)


def _features(run: StoredRun, frame: MapFrame) -> list[dict[str, Any]]:
    features = []
    for key, row in run.queries.iterrows():
        found = run.predictions[str(key)]
        stated: dict[str, Any] = {"name": row["query"], "split": row["split"], "trust": trust_of(found)}
        numbers = (
            ("score", "probability", "translation_error_m", "rotation_error_deg")
            if key in run.poses
            else ("score",)
        )
        stated |= {name: round(row[name], 4) for name in numbers if math.isfinite(row[name])}
        if reason := own_failure(row["failure"]):
            stated["failure"] = reason
        pose = run.poses.get(str(key))
        if pose is None:
            features.append(nowhere_feature(stated))
        else:
            features.append(camera_feature(frame, pose, stated, found.covariance))
    return features
