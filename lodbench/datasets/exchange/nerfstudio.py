"""Nerfstudio's ``transforms.json``: camera-to-world matrices with OpenGL axes (x right, y up, z back)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.exchange.posed import FoundPose, LayoutGuard, inverted, read_json, require_plain_names
from lodbench.errors import DatasetError, LodbenchError
from lodbench.geometry import Camera, Pose
from lodbench.geometry.angles import blender_from_opencv
from lodbench.storage import write_text

_LAYOUT = "file_path and transform_matrix (4 x 4) of each frame"
# Along x and y: pixels, or the angle that the whole picture sees, as Blender and instant-ngp write it.
_FOCAL_KEYS = (("fl_x", "camera_angle_x"), ("fl_y", "camera_angle_y"))
_OPENCV_KEYS = ("k1", "k2", "p1", "p2")
_FISHEYE_KEYS = ("k1", "k2", "k3", "k4")
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")


def read_nerfstudio(path: Path) -> Iterator[FoundPose]:
    """Yields the frames of a ``transforms.json``, in the frame before ``applied_transform``.

    Raises:
        DatasetError: The file is missing or malformed, or a camera model cannot be read.
    """
    path = path / "transforms.json" if path.is_dir() else path
    values = read_json(path)
    with LayoutGuard(str(path), "a list of frames"):
        frames = values["frames"]
        if not isinstance(frames, list):
            raise LodbenchError("the frames are no list")
        back, scale = _undoing(values)
    for number, frame in enumerate(frames):
        where = f"{path}, frame {number}"
        with LayoutGuard(where, _LAYOUT):
            name = str(frame["file_path"])
            world_from_cam = np.array(frame["transform_matrix"], dtype=np.float64)
            if world_from_cam.shape == (3, 4):
                world_from_cam = np.vstack([world_from_cam, [0.0, 0.0, 0.0, 1.0]])
            if world_from_cam.shape != (4, 4):
                raise LodbenchError("the transform_matrix is not 4 x 4")
            world_from_cam[:3, 3] /= scale
            pose = inverted(Pose.from_matrix(blender_from_opencv(back @ world_from_cam)))
            camera = _camera({**values, **frame})
        yield FoundPose(name, where, pose, camera)


def write_nerfstudio(images: Sequence[FoundPose], path: Path) -> None:
    """Writes a ``transforms.json``, each frame with its own intrinsics.

    Nerfstudio keeps positions in single precision, which is half a metre at the coordinates of a map. So
    the cameras' middle, in whole metres, is taken off, and ``applied_transform`` says so. Positions
    come back to 1e-9 m at map coordinates.

    Raises:
        DatasetError: An image has no camera, or a lens that nerfstudio has not.
    """
    require_plain_names([image.name for image in images], "\r\n", "a transforms.json")
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


def _intrinsics(image: FoundPose) -> dict[str, Any]:
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
