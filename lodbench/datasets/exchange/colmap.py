"""COLMAP models: a folder of cameras, images and points, as text or binary; poses are world to camera."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets import pose_text
from lodbench.datasets.exchange.colmap_moved import (
    BYTES_PER_POINT,
    BYTES_PER_TRACK,
    RIG_FILES,
    PosedImage,
    lone_cameras,
    require_no_binary,
)
from lodbench.errors import DatasetError, LodbenchError
from lodbench.geometry import Camera, Pose
from lodbench.geometry.camera import colmap_parameters
from lodbench.storage import make_folder, write_bytes, write_text

_IMAGE_LAYOUT = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
# COLMAP's number of each camera model in binary files.
_MODEL_NAMES = {
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
    12: "SIMPLE_DIVISION",
    13: "DIVISION",
    14: "SIMPLE_FISHEYE",
    15: "FISHEYE",
    16: "EUCM",
}
_Cameras = Mapping[int, Camera | str]


def is_colmap(folder: Path) -> bool:
    """Tells whether a folder holds a COLMAP model."""
    return any((folder / f"images{ending}").is_file() for ending in (".txt", ".bin"))


def models_below(folder: Path) -> list[Path]:
    """Returns the models in a folder's folders, and in theirs: COLMAP writes ``sparse/0``, ``sparse/1``."""
    places = [f"{depth}/images.{ending}" for depth in ("*", "*/*") for ending in ("txt", "bin")]
    return sorted({file.parent for place in places for file in folder.glob(place)})


def read_colmap(path: Path) -> Iterator[pose_text.FoundPose]:
    """Yields the posed images of a model.

    Args:
        path: The model's folder (binary files go before text, as in COLMAP), or its images file alone:
            cameras are then read where they lie beside it.

    Images of a camera whose model is not known have none, and say so.

    Raises:
        DatasetError: A file is missing, cut off or malformed.
    """
    if path.is_dir():
        name = "images.bin" if (path / "images.bin").is_file() else "images.txt"
        path = path / name
        if not path.is_file():
            below = ", ".join(map(str, models_below(path.parent)))
            hint = f"Name one of those below it: {below}" if below else "It has images.txt or images.bin."
            raise DatasetError(f"{path.parent} holds no COLMAP model.", hint)
        if not path.with_stem("cameras").is_file():
            hint = "A COLMAP model has images and cameras, both as .txt or as .bin."
            raise DatasetError(f"{path.parent} has no {path.with_stem('cameras').name}.", hint)
    cameras_file = path.with_stem("cameras")
    read_cameras, read_images = (
        (_binary_cameras, _binary_images) if path.suffix == ".bin" else (_text_cameras, _text_images)
    )
    cameras = read_cameras(cameras_file) if cameras_file.is_file() and cameras_file != path else None
    faults = [camera for camera in (cameras or {}).values() if isinstance(camera, str)]
    if cameras and len(faults) == len(cameras):
        raise DatasetError(f"{cameras_file} has no camera that can be had: {faults[0]}.")
    return read_images(path, cameras)


def read_colmap_points(folder: Path) -> NDArray[np.float64]:
    """Returns (N, 3) the sparse points of a model; none where it has no file of them.

    Raises:
        DatasetError: The file is cut off or malformed.
    """
    path = folder / "points3D.bin"
    if path.is_file():
        data, points = _Bytes(path), []
        for _ in range(data.take("<Q")[0]):
            points.append(data.take("<Q3d3Bd")[1:4])
            data.skip(data.take("<Q")[0] * BYTES_PER_TRACK)
        return np.array(points, np.float64).reshape(-1, 3)
    path = folder / "points3D.txt"
    if not path.is_file():
        return np.zeros((0, 3))
    coordinates = []
    for where, line in pose_text.content(path):
        with pose_text.LayoutGuard(where, "POINT3D_ID X Y Z R G B ERROR TRACK[]"):
            _, x, y, z, *_ = line.split()
            coordinates.append([float(x), float(y), float(z)])
    return np.array(coordinates, np.float64).reshape(-1, 3)


def write_colmap(images: Sequence[pose_text.FoundPose], folder: Path) -> None:
    """Writes a model without points as text; equal cameras are one, and each is a rig of its own.

    Reading it gives the same translations and intrinsics to the bit, and rotations to rounding.

    Raises:
        DatasetError: An image has no camera, two have one name, or the folder holds a binary model.
    """
    require_no_binary(folder)
    pose_text.require_plain_names([image.name for image in images], "\r\n", "a COLMAP model")
    numbers: dict[Camera, int] = {}
    posed: list[PosedImage] = []
    image_lines = [f"# {_IMAGE_LAYOUT}, then a line of points (none here)"]
    for number, image in enumerate(images, start=1):
        if image.camera is None:
            raise DatasetError(f"{image.name} has no camera, and a COLMAP model needs one.")
        camera = numbers.setdefault(image.camera, len(numbers) + 1)
        posed.append(PosedImage(number, tuple(pose_text.numbers_of(image.pose)), camera))
        pose = " ".join(map(repr, posed[-1].numbers))
        image_lines += [f"{number} {pose} {camera} {image.name}", ""]
    camera_lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    for camera_model, number in numbers.items():
        model, params = camera_model.to_colmap()
        size = f"{camera_model.width} {camera_model.height}"
        camera_lines.append(f"{number} {model} {size} {' '.join(map(repr, params))}")
    make_folder(folder)
    write_text(folder / "cameras.txt", pose_text.lines_to_text(camera_lines))
    write_text(folder / "images.txt", pose_text.lines_to_text(image_lines))
    write_text(folder / "points3D.txt", "# no points\n")
    for name, content_of in zip(RIG_FILES, lone_cameras(posed, "txt"), strict=True):
        write_bytes(folder / f"{name}.txt", content_of)


def _text_cameras(path: Path) -> dict[int, Camera | str]:
    """Returns cameras by number, or why one cannot be had."""
    cameras: dict[int, Camera | str] = {}
    for where, line in pose_text.content(path):
        with pose_text.LayoutGuard(where, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"):
            words = line.split()
            if len(words) < 5:
                raise LodbenchError(f"{len(words)} values, too few for a camera")
            params = [float(word) for word in words[4:]]
            number, size = int(words[0]), (int(words[2]), int(words[3]))
            is_known = words[1] in _MODEL_NAMES.values()
            cameras[number] = Camera.from_colmap(words[1], *size, params) if is_known else _lacking(words[1])
    return cameras


def _lacking(model: object) -> str:
    return f"its camera has the model {str(model)[:60]}, which is not known"


def _text_images(path: Path, cameras: _Cameras | None) -> Iterator[pose_text.FoundPose]:
    lines = pose_text.content(path, keep_empty=True)
    for where, line in lines:
        if not line.strip():
            continue
        with pose_text.LayoutGuard(where, _IMAGE_LAYOUT):
            words = line.split(maxsplit=9)
            if len(words) != 10:
                raise LodbenchError(f"{len(words)} values instead of 10")
            pose = pose_text.parse_pose(words[1:8])
            camera, fault = _camera_of(cameras, int(words[8]))
        points_at, points = next(lines, (where, ""))
        with pose_text.LayoutGuard(
            points_at, "X Y POINT3D_ID of each point; the line may be empty, but is there"
        ):
            # A file without these lines would lose every second image in silence.
            if len(points.split()) % 3:
                raise LodbenchError(f"{len(points.split())} values are no list of points")
        yield pose_text.FoundPose(
            pose_text.with_slashes(words[9].strip()), where, pose, camera, no_camera=fault
        )


def _camera_of(cameras: _Cameras | None, number: int) -> tuple[Camera | None, str]:
    """Returns a camera, or None and why there is none."""
    if cameras is None:
        return None, ""
    if number not in cameras:
        raise LodbenchError(f"there is no camera {number}")
    camera = cameras[number]
    return (None, camera) if isinstance(camera, str) else (camera, "")


class _Bytes:
    """A binary file read from the front; running out of bytes is an error that names the file."""

    def __init__(self, path: Path) -> None:
        try:
            self._data = path.read_bytes()
        except OSError as error:
            raise DatasetError(f"{path} cannot be read: {error.strerror}.") from error
        self._path, self._at = path, 0

    @property
    def where(self) -> str:
        return f"{self._path}, byte {self._at}"

    def take(self, layout: str) -> tuple[Any, ...]:
        values = self._checked(struct.calcsize(layout))
        return struct.unpack(layout, values)

    def skip(self, count: int) -> None:
        self._checked(count)

    def take_text(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise DatasetError(f"{self.where}: the file is cut off.", "Copy it again.")
        raw = self._data[self._at : end]
        self._at = end + 1
        return raw.decode("utf-8")

    def _checked(self, count: int) -> bytes:
        if count > len(self._data) - self._at:
            raise DatasetError(f"{self.where}: the file is cut off.", "Copy it again.")
        self._at += count
        return self._data[self._at - count : self._at]


def _binary_cameras(path: Path) -> dict[int, Camera | str]:
    """Returns cameras by number, or why one cannot be had: one of an unknown model, and all behind it."""
    data, cameras = _Bytes(path), dict[int, Camera | str]()
    (count,) = data.take("<Q")
    for _ in range(count):
        with pose_text.LayoutGuard(data.where, "a camera of COLMAP's binary format"):
            number, model, width, height = data.take("<iiQQ")
            if model not in _MODEL_NAMES:
                return _Lost(cameras | {number: _lacking(f"number {model}")}, model)
            name = _MODEL_NAMES[model]
            params = data.take(f"<{len(colmap_parameters(name))}d")
            cameras[number] = Camera.from_colmap(name, width, height, params)
    return cameras


class _Lost(dict[int, Camera | str]):
    """Cameras of a binary file up to one of an unknown model, whose length is not known, nor what follows."""

    def __init__(self, cameras: dict[int, Camera | str], model: int) -> None:
        super().__init__(cameras)
        self._reason = f"its camera stands behind one of the model number {model}, which is not known"

    def __contains__(self, number: object) -> bool:
        return True

    def __missing__(self, number: int) -> str:
        return self._reason


def _binary_images(path: Path, cameras: _Cameras | None) -> Iterator[pose_text.FoundPose]:
    data = _Bytes(path)
    (count,) = data.take("<Q")
    for _ in range(count):
        where = data.where
        with pose_text.LayoutGuard(where, "an image of COLMAP's binary format"):
            _, *numbers, camera_number = data.take("<i7di")
            name = data.take_text()
            pose = Pose.from_quaternion(numbers[:4], numbers[4:])
            camera, fault = _camera_of(cameras, camera_number)
            (num_points,) = data.take("<Q")
            data.skip(num_points * BYTES_PER_POINT)
        yield pose_text.FoundPose(pose_text.with_slashes(name), where, pose, camera, no_camera=fault)
