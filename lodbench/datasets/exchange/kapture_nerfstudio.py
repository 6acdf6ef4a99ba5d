"""Kapture's folders and nerfstudio's ``transforms.json``.

Kapture (naver/kapture, format 1.1) has comma-separated files, poses are world to camera. Nerfstudio has
camera-to-world matrices with OpenGL axes (x right, y up, z back).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets import pose_text
from lodbench.errors import DatasetError, LodbenchError
from lodbench.geometry import Camera, Pose
from lodbench.geometry.angles import blender_from_opencv
from lodbench.storage import make_folder, write_text

_VERSION = "# kapture format: 1.1"
_SENSORS, _TRAJECTORIES, _RECORDS, _RIGS = (
    f"sensors/{name}.txt" for name in ("sensors", "trajectories", "records_camera", "rigs")
)
# What kapture 1.1 can hold of COLMAP's lenses.
_LENSES = ("OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "FOV", "THIN_PRISM_FISHEYE")


def is_kapture(folder: Path) -> bool:
    """Tells whether a folder holds a kapture."""
    return (folder / _SENSORS).is_file()


def read_kapture(path: Path) -> Iterator[pose_text.FoundPose]:
    """Yields the images that have a pose; images without one are left to the caller to miss.

    Raises:
        DatasetError: A file is missing or malformed, or poses are those of a rig.
    """
    if not path.is_dir():
        raise DatasetError(f"{path} is not a folder.", "A kapture is a folder with sensors/ in it.")
    if (path / _RIGS).is_file() and next(pose_text.content(path / _RIGS), None):
        raise DatasetError(f"{path} has rigs.", "Turn them into camera poses first: kapture's rigs_remove.")
    cameras = _read_cameras(path / _SENSORS)
    poses = _read_poses(path / _TRAJECTORIES)
    for where, timestamp, device, name in _records(path):
        with pose_text.LayoutGuard(where, "a camera of sensors.txt"):
            if device not in cameras:
                raise LodbenchError(f"there is no camera {device!r}")
        pose = poses.get((timestamp, device))
        if pose is not None:
            yield pose_text.FoundPose(name, where, pose, cameras[device])


def unposed_images(path: Path) -> list[str]:
    """Returns the names of a kapture's images that have no pose.

    Raises:
        DatasetError: A file is missing or malformed.
    """
    poses = _read_poses(path / _TRAJECTORIES)
    return [name for _, timestamp, device, name in _records(path) if (timestamp, device) not in poses]


def write_kapture(images: Sequence[pose_text.FoundPose], folder: Path) -> None:
    """Writes a kapture without the pictures, which belong in ``sensors/records_data``.

    Timestamps are the images' numbers. Reading it gives the same translations and intrinsics to the
    bit, and rotations to rounding.

    Raises:
        DatasetError: A name has a comma, an image has no camera, or one that kapture cannot hold.
    """
    pose_text.require_plain_names([image.name for image in images], ",\r\n", "a kapture")
    devices: dict[Camera, str] = {}
    poses, records = [], []
    for number, image in enumerate(images):
        if image.camera is None:
            raise DatasetError(f"{image.name} has no camera, and a kapture needs one.")
        if image.camera.distortion and image.camera.lens not in _LENSES:
            raise DatasetError(f"{image.name}: kapture has no camera model {image.camera.lens}.")
        device = devices.setdefault(image.camera, f"camera{len(devices)}")
        poses.append(", ".join([str(number), device, *map(repr, pose_text.numbers_of(image.pose))]))
        records.append(f"{number}, {device}, {image.name}")
    sensors = []
    for camera, device in devices.items():
        model, params = camera.to_colmap()
        cells = [device, "", "camera", model, str(camera.width), str(camera.height), *map(repr, params)]
        sensors.append(", ".join(cells))
    make_folder(folder / "sensors")
    for name, head, lines in (
        (_SENSORS, "# sensor_id, name, sensor_type, [sensor_params]+", sensors),
        (_TRAJECTORIES, "# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz", poses),
        (_RECORDS, "# timestamp, device_id, image_path", records),
    ):
        write_text(folder / name, pose_text.lines_to_text([_VERSION, head, *lines]))


def _records(path: Path) -> Iterator[tuple[str, str, str, str]]:
    """Yields the place, timestamp, device and name of each image."""
    for where, line in pose_text.content(path / _RECORDS):
        with pose_text.LayoutGuard(where, "timestamp, device_id, image_path"):
            timestamp, device, name = _cells(line, 3)
        yield where, timestamp, device, name


def _cells(line: str, count: int) -> list[str]:
    cells = [cell.strip() for cell in line.split(",")]
    if len(cells) != count:
        raise LodbenchError(f"{len(cells)} values instead of {count}")
    return cells


def _read_cameras(path: Path) -> dict[str, Camera | None]:
    """Returns cameras by device; None for those whose intrinsics are not known."""
    cameras: dict[str, Camera | None] = {}
    for where, line in pose_text.content(path):
        with pose_text.LayoutGuard(where, "sensor_id, name, camera, MODEL, WIDTH, HEIGHT, PARAMS"):
            cells = [cell.strip() for cell in line.split(",")]
            if len(cells) < 3:
                raise LodbenchError(f"{len(cells)} values, too few for a sensor")
            device, _, kind, *rest = cells
            if kind != "camera":
                continue
            if len(rest) < 3:
                raise LodbenchError("a camera without its size")
            params = [float(cell) for cell in rest[3:]]
            is_known = rest[0] != "UNKNOWN_CAMERA"
            size = int(rest[1]), int(rest[2])
            cameras[device] = Camera.from_colmap(rest[0], *size, params) if is_known else None
    return cameras


def _read_poses(path: Path) -> dict[tuple[str, str], Pose]:
    poses: dict[tuple[str, str], Pose] = {}
    for where, line in pose_text.content(path):
        with pose_text.LayoutGuard(where, "timestamp, device_id, qw, qx, qy, qz, tx, ty, tz"):
            timestamp, device, *numbers = _cells(line, 9)
            # Half a pose, which kapture allows, is no pose.
            if all(numbers):
                poses[timestamp, device] = pose_text.parse_pose(numbers)
    return poses


_LAYOUT = "file_path and transform_matrix (4 x 4) of each frame"
# Along x and y: pixels, or the angle that the whole picture sees, as Blender and instant-ngp write it.
_FOCAL_KEYS = (("fl_x", "camera_angle_x"), ("fl_y", "camera_angle_y"))
_OPENCV_KEYS = ("k1", "k2", "p1", "p2")
_FISHEYE_KEYS = ("k1", "k2", "k3", "k4")
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")


def read_nerfstudio(path: Path) -> Iterator[pose_text.FoundPose]:
    """Yields the frames of a ``transforms.json``, in the frame before ``applied_transform``.

    Raises:
        DatasetError: The file is missing or malformed, or a camera model cannot be read.
    """
    path = path / "transforms.json" if path.is_dir() else path
    values = pose_text.read_json(path)
    with pose_text.LayoutGuard(str(path), "a list of frames"):
        frames = values["frames"]
        if not isinstance(frames, list):
            raise LodbenchError("the frames are no list")
        back, scale = _undoing(values)
    for number, frame in enumerate(frames):
        where = f"{path}, frame {number}"
        with pose_text.LayoutGuard(where, _LAYOUT):
            name = str(frame["file_path"])
            world_from_cam = np.array(frame["transform_matrix"], dtype=np.float64)
            if world_from_cam.shape == (3, 4):
                world_from_cam = np.vstack([world_from_cam, [0.0, 0.0, 0.0, 1.0]])
            if world_from_cam.shape != (4, 4):
                raise LodbenchError("the transform_matrix is not 4 x 4")
            world_from_cam[:3, 3] /= scale
            pose = pose_text.inverted(Pose.from_matrix(blender_from_opencv(back @ world_from_cam)))
            camera = _camera({**values, **frame})
        yield pose_text.FoundPose(name, where, pose, camera)


def write_nerfstudio(images: Sequence[pose_text.FoundPose], path: Path) -> None:
    """Writes a ``transforms.json``, each frame with its own intrinsics.

    Nerfstudio keeps positions in single precision, which is half a metre at the coordinates of a map. So
    the cameras' middle, in whole metres, is taken off, and ``applied_transform`` says so. Positions
    come back to 1e-9 m at map coordinates.

    Raises:
        DatasetError: An image has no camera, or a lens that nerfstudio has not.
    """
    pose_text.require_plain_names([image.name for image in images], "\r\n", "a transforms.json")
    centers = np.array([image.pose.center for image in images]).reshape(-1, 3)
    middle = np.asarray(np.round(centers.mean(axis=0)) if images else np.zeros(3))
    frames = []
    for image in images:
        matrix = blender_from_opencv(image.pose.shifted(-middle).world_from_cam)
        frames.append({"file_path": image.name, **_intrinsics(image), "transform_matrix": matrix.tolist()})
    applied = np.hstack([np.eye(3), -middle[:, None]]).tolist()
    values = {"camera_model": "OPENCV", "applied_transform": applied, "frames": frames}
    write_text(path, json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _undoing(values: Mapping[str, Any]) -> tuple[NDArray[np.float64], float]:
    """Returns the (4, 4) matrix and the scale that take back what was done to the poses."""
    applied = np.eye(4)
    if "applied_transform" in values:
        given = np.array(values["applied_transform"], dtype=np.float64)
        if given.shape not in ((3, 4), (4, 4)):
            raise LodbenchError("applied_transform is not 3 x 4")
        applied[: len(given)] = given
    scale = float(values.get("applied_scale", 1.0))
    if not (np.isfinite(applied).all() and abs(np.linalg.det(applied[:3, :3])) > 1e-12 and scale > 0):
        raise LodbenchError("applied_transform or applied_scale cannot be undone")
    return np.asarray(np.linalg.inv(applied), dtype=np.float64), scale


def _camera(values: Mapping[str, Any]) -> Camera | None:
    # Blender's files tell the angle alone, not the size of the pictures.
    if not any(key in values for keys in _FOCAL_KEYS for key in keys) or not {"w", "h"} <= values.keys():
        return None
    width, height = int(values["w"]), int(values["h"])
    stated = [_focal_px(values, *keys, size) for keys, size in zip(_FOCAL_KEYS, (width, height), strict=True)]
    focal_px = [focal for focal in stated if focal is not None]
    # One alone is that of both: pixels are square.
    size_and_focal = width, height, focal_px[0], focal_px[-1]
    center = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    # Of instant-ngp, whose k1 to k4 are then the fisheye's.
    usual = "OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV"
    model = str(values.get("camera_model", usual))
    if model == "OPENCV_FISHEYE":
        lens = tuple(float(values.get(key, 0.0)) for key in _FISHEYE_KEYS)
        return Camera(*size_and_focal, *center, lens, model)
    if model not in ("OPENCV", *_PINHOLES):
        raise LodbenchError(f"the camera model {model} cannot be read")
    if float(values.get("k4", 0.0)) != 0.0:
        raise LodbenchError("a fourth radial coefficient cannot be read")
    k3 = float(values.get("k3", 0.0))
    distortion = tuple(float(values.get(key, 0.0)) for key in _OPENCV_KEYS)
    if k3:
        return Camera(*size_and_focal, *center, (*distortion, k3, 0.0, 0.0, 0.0), "FULL_OPENCV")
    return Camera(*size_and_focal, *center, distortion if any(distortion) else ())


def _focal_px(values: Mapping[str, Any], focal: str, angle: str, size: int) -> float | None:
    """Returns a focal length as stated, else from the field of view in radians; None without either."""
    if focal in values:
        return float(values[focal])
    return size / 2 / float(np.tan(float(values[angle]) / 2)) if angle in values else None


def _intrinsics(image: pose_text.FoundPose) -> dict[str, Any]:
    camera = image.camera
    if camera is None:
        raise DatasetError(f"{image.name} has no camera, and nerfstudio needs one.")
    values = {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
    }
    if not camera.distortion:
        return values
    if camera.lens == "OPENCV_FISHEYE":
        names = dict(zip(_FISHEYE_KEYS, camera.distortion, strict=True))
        return {"camera_model": "OPENCV_FISHEYE", **values, **names}
    is_short = camera.lens == "FULL_OPENCV" and not any(camera.distortion[5:])
    if camera.lens != "OPENCV" and not is_short:
        raise DatasetError(f"{image.name}: nerfstudio has no camera model {camera.lens}.")
    names = dict(zip((*_OPENCV_KEYS, "k3"), camera.distortion, strict=False))
    return {**values, **names}
