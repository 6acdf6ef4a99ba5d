"""A run as a recording for the Rerun viewer: the city, the cameras of every query, photos and masks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Entry
from lodbench.evaluation.queries import ERROR, PRIOR_ERROR
from lodbench.extras import require
from lodbench.geometry import Camera, Pose
from lodbench.harness.export.formats import CITY, DATASET, Export
from lodbench.harness.runs.queries import prior_of
from lodbench.photos.pictures import read_picture
from lodbench.reporting.overlays import ESTIMATE_COLOUR, PRIOR_COLOUR, TRUTH_COLOUR
from lodbench.storage import write_bytes

if TYPE_CHECKING:
    import pandas as pd

# BGR of each kind of pose, as in the overlays.
_COLOURS = {"prior": PRIOR_COLOUR, "truth": TRUTH_COLOUR, "estimate": ESTIMATE_COLOUR}
_CITY_RGB = (176, 172, 164)
# How far before a camera its picture is shown, metres.
_PICTURE_M = 20.0
_TIMELINE = "query"


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
    found = f"score {row['score']}, {row['hypotheses']:.0f} hypotheses"
    lines = [f"### {row.name}", row["failure"] or found]
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
