"""A run for other programs: what formats are given, where they write, and all but Rerun's."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from lodbench.citymodel.scene import Scene
from lodbench.citymodel.source import is_own_geopackage
from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.exchange.colmap_moved import require_no_binary
from lodbench.datasets.exchange.geojson import (
    camera_feature,
    nowhere_feature,
    write_geojson,
    write_geopackage,
)
from lodbench.datasets.exchange.kapture_nerfstudio import write_kapture, write_nerfstudio
from lodbench.datasets.exchange.lines import write_lines, write_tum
from lodbench.datasets.exchange.photogrammetry import write_metashape, write_odm, write_pix4d
from lodbench.datasets.pose_text import FoundPose
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation.queries import own_failure, queries_csv
from lodbench.harness.runs.places import survey_csv
from lodbench.harness.runs.stored import StoredRun
from lodbench.photos.map_frame import MapFrame
from lodbench.plugins import blaming, load_plugin
from lodbench.reporting.answers import trust_of
from lodbench.storage import make_folder, scratch_folder, write_bytes, write_text
from lodbench.storage.disk import disk

if TYPE_CHECKING:
    import pandas as pd

# The first line of a table of queries has some 200 bytes.
_HEAD_BYTES = 4096
# What a format may require beside the run.
DATASET, CITY, CRS = "dataset", "city", "crs"


@dataclass(frozen=True, slots=True, eq=False)
class Export:
    """What a format is given; what it does not require may be None."""

    run: StoredRun
    dataset: Dataset | None = None
    city: Scene | None = None
    crs: str | None = None

    def poses(self) -> list[FoundPose]:
        """Returns the poses, named as their images if the run has one split, else as ``split/name``.

        Cameras are those of the dataset, where it is open.
        """
        names = self.run.queries["query"]
        if self.run.queries["split"].nunique() > 1:
            names = self.run.queries.index.to_series()
        entries = () if self.dataset is None else self.dataset.entries
        cameras = {entry.key: entry.camera for entry in entries}
        known = self.run.poses
        return [FoundPose(name, "", known[k], cameras.get(k)) for k, name in names.items() if k in known]


class ExportFormat(Protocol):
    """How a run is written for another program; made without arguments.

    Attributes:
        file_name: File or folder that is written to the run's folder ``export`` where no other is named.
        requires: Of ``dataset``, ``city`` and ``crs``, what the export must hold.

    Offered if the class has it: ``require_room(path)``, which raises where programs would not read what is
    written there; ``optional``, of the same names as ``requires``, what the export holds if it is known;
    ``convention``, what is to be known of its angles, in words.
    """

    file_name: str

    @property
    def requires(self) -> Collection[str]:
        """Returns what it requires; a class attribute will do."""
        ...

    def write(self, export: Export, path: Path) -> None:
        """Writes the run; the folder above ``path`` is there.

        Raises:
            LodbenchError: It holds something that the format cannot.
        """
        ...


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written."""

    path: Path
    count: int
    without_pose: tuple[str, ...]


def wanted_by(form: ExportFormat) -> set[str]:
    """Returns what a format requires, and what it takes where it is known."""
    return {*form.requires, *getattr(form, "optional", ())}


def make_format(name: str) -> ExportFormat:
    """Returns the format of a name.

    Raises:
        ConfigError: There is no such format, or it cannot be made.
    """
    kind = load_plugin("export_formats", name)
    with blaming("export_formats", name, "be made"):
        made: ExportFormat = kind()
        Path(made.file_name), wanted_by(made)
    return made


def export_run(export: Export, form: ExportFormat, out: Path | None = None) -> Exported:
    """Writes a run in a format.

    Args:
        export: The run, and what the format requires.
        form: The format.
        out: File or folder to write; by default in the run's folder ``export``.

    What is there already stays as it is until all is written; other files in a folder stay. Outside of the
    run's folder ``export`` only earlier exports in the format are replaced.

    Raises:
        LodbenchError: The run has no poses, the format cannot hold it, or something else is in its place.
    """
    run = export.run
    if not run.poses:
        raise DatasetError(f"{run.folder} holds no poses.", "queries.csv says why each query failed.")
    path = out or run.folder / "export" / form.file_name
    if hasattr(form, "require_room"):
        form.require_room(path)
    make_folder(path.parent)
    with scratch_folder(path.parent / "export") as folder:
        written = folder / path.resolve().name
        try:
            form.write(export, written)
        except OSError as error:
            if str(error.filename).startswith(str(folder)):
                error.filename = str(path)
            raise
        if not written.exists():
            raise ValueError(f"nothing was written to {path.name}")
        if (run.folder / "export").resolve() not in path.resolve().parents:
            _require_room(written, path)
        _put_in_place(written, path)
    without = run.queries["query"][~run.queries.index.isin(list(run.poses))]
    return Exported(path, len(run.poses), tuple(without))


def _require_room(written: Path, path: Path) -> None:
    """Checks that no file is replaced that is no such export."""
    if written.is_dir():
        for each in written.iterdir():
            _require_room(each, path / each.name)
    elif path.is_file() and _head(path) != _head(written) and path.read_bytes() != written.read_bytes():
        raise ConfigError(f"{path} is there already, and is no such export.", "Name another with `--out`.")


def _head(file: Path) -> bytes:
    """Returns what a file says of its form: its first line, of JSON three, of what is no text four bytes."""
    with file.open("rb") as stream:
        start = stream.read(_HEAD_BYTES)
    if b"\0" in start:
        return start[:4]
    lines = start.splitlines()[:3]
    return b"\n".join(lines if lines[:1] == [b"{"] else lines[:1])


def _put_in_place(written: Path, path: Path) -> None:
    """Gives a file, or each file of a folder, its name."""
    if written.is_dir():
        make_folder(path)
        for each in sorted(written.iterdir()):
            _put_in_place(each, path / each.name)
    elif path.is_dir():
        raise DatasetError(f"{path} is a folder.", "Name a file with `--out`.")
    else:
        disk().rename(written, path)


_OF_CSV = (
    "those of csv: heading from true north, pitch -90 straight down and 0 level, roll about the optical axis"
)
_OMEGA_PHI_KAPPA = (
    "omega, phi, kappa about the axes of the coordinates, all 0 straight down with grid north on top; "
    f"{_OF_CSV}"
)


class _Poses:
    """A format of poses alone, written by a function of poses, path and, where it is required, CRS."""

    file_name: str
    requires: tuple[str, ...] = ()
    writer: ClassVar[Any]

    def write(self, export: Export, path: Path) -> None:
        """Writes the file or folder."""
        type(self).writer(export.poses(), path, *([export.crs] if CRS in self.requires else []))


def _poses(of: str, file_name: str, writer: Any, *requires: str, **more: Any) -> type[_Poses]:
    """Returns the format of a program, ``of``."""
    return type(
        "Poses",
        (_Poses,),
        {"__doc__": of, "file_name": file_name, "requires": requires, "writer": writer, **more},
    )


Colmap = _poses(
    "COLMAP's text model: a folder of cameras and images.", "colmap", write_colmap, DATASET,
    require_room=staticmethod(require_no_binary),
)  # fmt: skip
Kapture = _poses("kapture's folder of sensors and trajectories.", "kapture", write_kapture, DATASET)
Nerfstudio = _poses(
    "nerfstudio's cameras and camera-to-world matrices.", "transforms.json", write_nerfstudio, DATASET
)
Tum = _poses("Trajectories of the TUM benchmark: a line per pose, camera to world.", "poses.tum", write_tum)
VisualLocalization = _poses(
    "Lines of visuallocalization.net: a pose each, world to camera.", "visuallocalization.txt", write_lines
)
Pix4D = _poses(
    "Pix4D's calibrated external camera parameters: centre, omega, phi, kappa.",
    "calibrated_external_camera_parameters.txt", write_pix4d, convention=_OMEGA_PHI_KAPPA,
)  # fmt: skip
Metashape = _poses(
    "The reference text that Metashape imports: centre, yaw, pitch, roll.",
    "metashape_reference.txt", write_metashape, CRS,
    convention="yaw from grid north, pitch 0 straight down and 90 level, roll about the picture's vertical "
    f"axis; {_OF_CSV}",
)  # fmt: skip
Odm = _poses(
    "OpenDroneMap's geo.txt: centre, omega, phi, kappa.", "geo.txt", write_odm, CRS,
    convention=_OMEGA_PHI_KAPPA,
)  # fmt: skip


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
                "Name the city model with `--city`, or the system with `--crs`.",
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
            raise ConfigError(
                f"{path} is there already, and is no such export.", "Name another with `--out`."
            )


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
    poses = pd.DataFrame.from_dict(numbers, orient="index", columns="qw qx qy qz tx ty tz".split())
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
