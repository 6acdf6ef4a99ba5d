"""A run for other programs: what formats are given, where they write, and the formats."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.citymodel.source import is_own_geopackage
from lodbench.datasets.exchange import colmap, colmap_moved, geojson, kapture_nerfstudio, photogrammetry
from lodbench.datasets.exchange.lines import write_lines, write_tum
from lodbench.datasets.pose_text import FoundPose
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation.metrics import ERROR, PRIOR_ERROR, own_failure, queries_csv
from lodbench.extras import require
from lodbench.geometry import Camera, Pose
from lodbench.harness.runs.places import survey_csv
from lodbench.harness.runs.queries import prior_of
from lodbench.harness.runs.stored import StoredRun
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.pictures import read_picture
from lodbench.plugins import blaming, load_plugin
from lodbench.reporting.answers import trust_label
from lodbench.reporting.overlays import ESTIMATE_COLOUR, PRIOR_COLOUR, TRUTH_COLOUR
from lodbench.storage import make_folder, scratch_folder, write_bytes, write_text
from lodbench.storage.disk import disk

if TYPE_CHECKING:
    import pandas as pd

# The first line of a table of queries has some 200 bytes.
_HEAD_BYTES = 4096
# What a format may require beside the run.
DATASET, CITY, CRS = "dataset", "city", "crs"
_OF_CSV = (
    "those of csv: heading from true north, pitch -90 straight down and 0 level, roll about the optical axis"
)
_OMEGA_PHI_KAPPA = (
    "omega, phi, kappa about the axes of the coordinates, all 0 straight down with grid north on top; "
    f"{_OF_CSV}"
)
# BGR of each kind of pose, as in the overlays.
_COLOURS = {"prior": PRIOR_COLOUR, "truth": TRUTH_COLOUR, "estimate": ESTIMATE_COLOUR}
_CITY_RGB = (176, 172, 164)
# How far before a camera its picture is shown, metres.
_PICTURE_M = 20.0
_TIMELINE = "query"


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
    "COLMAP's text model: a folder of cameras and images.", "colmap", colmap.write_colmap, DATASET,
    require_room=staticmethod(colmap_moved.require_no_binary),
)  # fmt: skip
Kapture = _poses(
    "kapture's folder of sensors and trajectories.", "kapture", kapture_nerfstudio.write_kapture, DATASET
)
Nerfstudio = _poses(
    "nerfstudio's cameras and camera-to-world matrices.",
    "transforms.json",
    kapture_nerfstudio.write_nerfstudio,
    DATASET,
)
Tum = _poses("Trajectories of the TUM benchmark: a line per pose, camera to world.", "poses.tum", write_tum)
VisualLocalization = _poses(
    "Lines of visuallocalization.net: a pose each, world to camera.", "visuallocalization.txt", write_lines
)
Pix4D = _poses(
    "Pix4D's calibrated external camera parameters: centre, omega, phi, kappa.",
    "calibrated_external_camera_parameters.txt", photogrammetry.write_pix4d, convention=_OMEGA_PHI_KAPPA,
)  # fmt: skip
Metashape = _poses(
    "The reference text that Metashape imports: centre, yaw, pitch, roll.",
    "metashape_reference.txt", photogrammetry.write_metashape, CRS,
    convention="yaw from grid north, pitch 0 straight down and 90 level, roll about the picture's vertical "
    f"axis; {_OF_CSV}",
)  # fmt: skip
Odm = _poses(
    "OpenDroneMap's geo.txt: centre, omega, phi, kappa.", "geo.txt", photogrammetry.write_odm, CRS,
    convention=_OMEGA_PHI_KAPPA,
)  # fmt: skip


class GeoJson:
    """A point for each pose, and a feature without a place for each query that has none."""

    file_name = "poses.geojson"
    requires = (CRS,)
    writer: ClassVar[Any] = geojson.write_geojson

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

    file_name, writer = "poses.gpkg", geojson.write_geopackage

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
        prediction = run.predictions[str(key)]
        stated: dict[str, Any] = {
            "name": row["query"],
            "split": row["split"],
            "trust": trust_label(prediction),
        }
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
            features.append(geojson.nowhere_feature(stated))
        else:
            features.append(geojson.camera_feature(frame, pose, stated, prediction.covariance))
    return features


class Rerun:
    """A recording for the Rerun viewer, in the city's local frame.

    Raises:
        ConfigError: Rerun's package is missing.
    """

    file_name = "run.rrd"
    requires = (DATASET, CITY)

    def __init__(self) -> None:
        require("rerun", "rerun", "--format rerun")

    def write(self, export: Export, path: Path) -> None:
        """Writes a recording with one step of the timeline ``query`` per query.

        Photos and the dataset's masks lie in the estimate's camera; why a query has none is stated.
        """
        import rerun as rr

        run, dataset, city = export.run, export.dataset, export.city
        assert dataset is not None and city is not None  # noqa: PT018, S101 - required
        record = rr.RecordingStream("lodbench", recording_id=f"lodbench {run.folder.name}")
        memory = record.memory_recording()
        record.send_blueprint(_layout())
        record.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        record.log("city", _mesh(city), static=True)
        tilt = "truth" if "truth" in set(run.queries["tilt"]) else "prior"
        entries = {entry.key: entry for entry in dataset.entries}
        for number, (key, row) in enumerate(run.queries.iterrows()):
            record.set_time(_TIMELINE, sequence=number)
            record.log("about", rr.TextDocument(_about(row), media_type="text/markdown"))
            entry = entries[str(key)]
            poses = {
                "prior": prior_of(entry, dataset, tilt),
                "truth": dataset.truth.get(entry.key),
                "estimate": run.poses.get(entry.key),
            }
            _log_query(record, entry, poses, city.origin)
        write_bytes(path, memory.drain_as_bytes())


def _log_query(record: Any, entry: Entry, poses: dict[str, Pose | None], origin: NDArray[np.float64]) -> None:
    import rerun as rr

    for kind, pose in poses.items():
        if pose is None:  # else the viewer would go on showing the last query's
            record.log(f"cameras/{kind}", rr.Clear(recursive=True))
        else:
            _log_camera(record, f"cameras/{kind}", pose.shifted(-origin), entry.camera, _COLOURS[kind])
    if poses["estimate"] is not None and entry.camera is not None:
        _log_pictures(record, "cameras/estimate", entry, entry.camera)


def _log_camera(
    record: Any, path: str, pose: Pose, camera: Camera | None, colour: tuple[int, int, int]
) -> None:
    import rerun as rr

    record.log(path, rr.Transform3D(translation=pose.center, mat3x3=pose.rotation.T))
    rgb = colour[::-1]
    record.log(f"{path}/centre", rr.Points3D([[0.0, 0.0, 0.0]], colors=[rgb], radii=[1.0]))
    if camera is not None:
        lens = rr.Pinhole(
            resolution=(camera.width, camera.height),
            focal_length=(camera.fx, camera.fy),
            principal_point=(camera.cx, camera.cy),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_PICTURE_M,
            color=rgb,
        )
        record.log(path, lens)


def _log_pictures(record: Any, path: str, entry: Entry, camera: Camera) -> None:
    """Logs the photo as it is stored, and the mask at the photo's size."""
    import cv2
    import rerun as rr

    photo, mask = (None if file is None else read_picture(file) for file in (entry.image, entry.mask))
    if photo is None or entry.image is None:
        record.log(f"{path}/photo", rr.Clear(recursive=False))
    elif entry.image.suffix.lower() in (".jpg", ".jpeg", ".png"):
        record.log(f"{path}/photo", rr.EncodedImage(path=entry.image))
    else:
        record.log(f"{path}/photo", rr.Image(photo, color_model="BGR").compress())
    if mask is None:
        record.log(f"{path}/mask", rr.Clear(recursive=False))
    else:
        size = (camera.width, camera.height)
        is_building = cv2.resize(mask[:, :, 0], size, interpolation=cv2.INTER_NEAREST) > 127
        record.log(f"{path}/mask", rr.SegmentationImage(is_building.astype(np.uint8), opacity=0.4))


def _mesh(scene: Scene) -> Any:
    """Returns the city with a normal per triangle: edges stay sharp in the viewer's light."""
    import rerun as rr

    corners = scene.vertices[scene.triangles.ravel()].astype(np.float64).reshape(-1, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3).astype(np.float32),
        vertex_normals=np.repeat(normals, 3, axis=0).astype(np.float32),
        triangle_indices=np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3),
        albedo_factor=_CITY_RGB,
    )


def _about(row: pd.Series[Any]) -> str:
    summary = f"score {row['score']}, {row['hypotheses']:.0f} hypotheses"
    lines = [f"### {row.name}", row["failure"] or summary]
    for what, (metres, degrees) in (("estimate", ERROR), ("prior", PRIOR_ERROR)):
        if np.isfinite(row[metres]):
            lines.append(f"- {what}: {row[metres]:.2f} m, {row[degrees]:.2f} deg from the truth")
    return "\n\n".join(lines)


def _layout() -> Any:
    """Returns how the viewer opens: the city, the photo with the city over it, and the numbers."""
    import rerun.blueprint as rrb

    photo = rrb.Spatial2DView(origin="cameras/estimate", name="photo")
    side = rrb.Vertical(photo, rrb.TextDocumentView(origin="about", name="about"), row_shares=[3, 1])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Spatial3DView(origin="/", name="city"), side), collapse_panels=True
    )
