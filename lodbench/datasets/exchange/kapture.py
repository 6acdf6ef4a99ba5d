"""Kapture (naver/kapture, format 1.1): a folder of comma-separated files; poses are world to camera."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from lodbench.datasets.exchange.posed import FoundPose, LayoutGuard, content, numbers_of, require_plain_names
from lodbench.datasets.pose_text import lines_to_text, parse_pose
from lodbench.errors import DatasetError, LodbenchError
from lodbench.geometry import Camera, Pose
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


def read_kapture(path: Path) -> Iterator[FoundPose]:
    """Yields the images that have a pose; images without one are left to the caller to miss.

    Raises:
        DatasetError: A file is missing or malformed, or poses are those of a rig.
    """
    if not path.is_dir():
        raise DatasetError(f"{path} is not a folder.", "A kapture is a folder with sensors/ in it.")
    if (path / _RIGS).is_file() and next(content(path / _RIGS), None):
        raise DatasetError(f"{path} has rigs.", "Turn them into camera poses first: kapture's rigs_remove.")
    cameras = _read_cameras(path / _SENSORS)
    poses = _read_poses(path / _TRAJECTORIES)
    for where, timestamp, device, name in _records(path):
        with LayoutGuard(where, "a camera of sensors.txt"):
            if device not in cameras:
                raise LodbenchError(f"there is no camera {device!r}")
        pose = poses.get((timestamp, device))
        if pose is not None:
            yield FoundPose(name, where, pose, cameras[device])


def unposed_images(path: Path) -> list[str]:
    """Returns the names of a kapture's images that have no pose.

    Raises:
        DatasetError: A file is missing or malformed.
    """
    poses = _read_poses(path / _TRAJECTORIES)
    return [name for _, timestamp, device, name in _records(path) if (timestamp, device) not in poses]


def write_kapture(images: Sequence[FoundPose], folder: Path) -> None:
    """Writes a kapture without the pictures, which belong in ``sensors/records_data``.

    Timestamps are the images' numbers. Reading it gives the same translations and intrinsics to the
    bit, and rotations to rounding.

    Raises:
        DatasetError: A name has a comma, an image has no camera, or one that kapture cannot hold.
    """
    require_plain_names([image.name for image in images], ",\r\n", "a kapture")
    devices: dict[Camera, str] = {}
    poses, records = [], []
    for number, image in enumerate(images):
        if image.camera is None:
            raise DatasetError(f"{image.name} has no camera, and a kapture needs one.")
        if image.camera.distortion and image.camera.lens not in _LENSES:
            raise DatasetError(f"{image.name}: kapture has no camera model {image.camera.lens}.")
        device = devices.setdefault(image.camera, f"camera{len(devices)}")
        poses.append(", ".join([str(number), device, *map(repr, numbers_of(image.pose))]))
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
        write_text(folder / name, lines_to_text([_VERSION, head, *lines]))


def _records(path: Path) -> Iterator[tuple[str, str, str, str]]:
    """Yields the place, timestamp, device and name of each image."""
    for where, line in content(path / _RECORDS):
        with LayoutGuard(where, "timestamp, device_id, image_path"):
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
    for where, line in content(path):
        with LayoutGuard(where, "sensor_id, name, camera, MODEL, WIDTH, HEIGHT, PARAMS"):
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
    for where, line in content(path):
        with LayoutGuard(where, "timestamp, device_id, qw, qx, qy, qz, tx, ty, tz"):
            timestamp, device, *numbers = _cells(line, 9)
            # Half a pose, which kapture allows, is no pose.
            if all(numbers):
                poses[timestamp, device] = parse_pose(numbers)
    return poses
