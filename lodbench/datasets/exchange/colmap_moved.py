"""COLMAP models moved by a similarity: poses, points, rigs and frames, everything else as it was.

Rigs and frames of COLMAP 4, whose poses go before those of images, are moved, or made of lone cameras.
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lodbench.datasets.pose_text import LayoutGuard
from lodbench.errors import DatasetError
from lodbench.geometry import Pose
from lodbench.geometry.similarity import Similarity
from lodbench.storage import make_folder, write_bytes

RIG_FILES = ("rigs", "frames")
_Move = Callable[[bytes, Similarity], bytes]
_CAMERA = "CAMERA"  # of the kinds of sensors, 0 in binary files
# Of an image, in images.bin; of a point, in points3D.bin.
BYTES_PER_POINT, BYTES_PER_TRACK = 24, 8


class PosedImage(NamedTuple):
    """An image of a model: number, quaternion and translation (world to camera), number of its camera."""

    number: int
    numbers: tuple[float, ...]
    camera: int


def moved_numbers(numbers: Sequence[float], similarity: Similarity) -> list[float]:
    """Returns quaternion and translation, world to camera or rig, after a similarity."""
    moved = similarity.pose(Pose.from_quaternion(list(numbers[:4]), list(numbers[4:7])))
    return [*moved.quat_wxyz, *map(float, moved.translation)]


def posed_images(content: bytes, ending: str) -> list[PosedImage]:
    """Returns the images of an images file, ``txt`` or ``bin``.

    Raises:
        ValueError, struct.error: It is malformed or cut off.
    """
    return list((_binary_posed if ending == "bin" else _text_posed)(content))


def _text_posed(content: bytes) -> Iterator[PosedImage]:
    is_points = False
    for line in content.decode("utf-8-sig").split("\n"):
        if line.lstrip().startswith("#") or not (line.strip() or is_points):
            continue
        if not is_points:
            words = line.split(maxsplit=9)
            yield PosedImage(int(words[0]), tuple(map(float, words[1:8])), int(words[8]))
        is_points = not is_points


def _binary_posed(content: bytes) -> Iterator[PosedImage]:
    (count,), at = struct.unpack_from("<Q", content), 8
    for _ in range(count):
        number, *numbers, camera = struct.unpack_from("<i7di", content, at)
        at = content.index(b"\0", at + 64) + 1
        (points,) = struct.unpack_from("<Q", content, at)
        at += 8 + points * BYTES_PER_POINT
        yield PosedImage(number, tuple(numbers), camera)


def lone_cameras(images: Sequence[PosedImage], ending: str) -> tuple[bytes, bytes]:
    """Returns rigs and frames as COLMAP makes them itself: a rig per camera, a frame per image."""
    cameras = sorted({image.camera for image in images})
    if ending == "bin":
        rigs = [struct.pack("<IIiI", camera, 1, 0, camera) for camera in cameras]
        frames = [
            struct.pack("<II7dIiIQ", n, camera, *numbers, 1, 0, camera, n) for n, numbers, camera in images
        ]
        return tuple(struct.pack("<Q", len(each)) + b"".join(each) for each in (rigs, frames))  # type: ignore[return-value]
    lines = ["# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[]"]
    lines += [f"{camera} 1 {_CAMERA} {camera}" for camera in cameras]
    rows = ["# FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], NUM_DATA_IDS, DATA_IDS[]"]
    rows += [
        f"{n} {camera} {' '.join(map(repr, numbers))} 1 {_CAMERA} {camera} {n}"
        for n, numbers, camera in images
    ]
    return "\n".join([*lines, ""]).encode(), "\n".join([*rows, ""]).encode()


def movers(ending: str) -> tuple[_Move, _Move]:
    """Returns what moves a rigs file and a frames file.

    Both raise ValueError or struct.error where the file is malformed or cut off.
    """
    return (_binary_rigs, _binary_frames) if ending == "bin" else (_text_rigs, _text_frames)


def _scaled(numbers: Sequence[float], similarity: Similarity) -> list[float]:
    """Returns the pose of a sensor in its rig, whose metres are others: sensor from rig."""
    return [*numbers[:4], *(similarity.scale * value for value in numbers[4:7])]


def _require_end(at: int, length: int) -> None:
    if at != length:
        raise ValueError(f"it ends at {length} instead of {at}")


def _lines(content: bytes, change: Callable[[list[str]], list[str]]) -> bytes:
    try:
        return "\n".join(
            line if line.lstrip().startswith("#") or not line.strip() else " ".join(change(line.split()))
            for line in content.decode("utf-8-sig").split("\n")
        ).encode("utf-8")
    except IndexError:
        raise ValueError("a line is too short") from None


def _text_rigs(content: bytes, similarity: Similarity) -> bytes:
    def change(words: list[str]) -> list[str]:
        at = 4  # behind the reference sensor, where there is one
        for _ in range(1, int(words[1])):
            at += 3
            if words[at - 1] == "1":
                numbers = [float(word) for word in words[at : at + 7]]
                words[at : at + 7] = map(repr, _scaled(numbers, similarity))
                at += 7
        _require_end(at if int(words[1]) else 2, len(words))
        return words

    return _lines(content, change)


def _text_frames(content: bytes, similarity: Similarity) -> bytes:
    def change(words: list[str]) -> list[str]:
        _require_end(10 + 3 * int(words[9]), len(words))
        moved = moved_numbers([float(word) for word in words[2:9]], similarity)
        return [*words[:2], *map(repr, moved), *words[9:]]

    return _lines(content, change)


def _binary_rigs(content: bytes, similarity: Similarity) -> bytes:
    moved, at = bytearray(content), 8
    (count,) = struct.unpack_from("<Q", content)
    for _ in range(count):
        _, sensors = struct.unpack_from("<II", content, at)
        at += 8 + 8 * min(sensors, 1)
        for _ in range(1, sensors):
            *_, has_pose = struct.unpack_from("<iIB", content, at)
            at += 9
            if has_pose:
                numbers = struct.unpack_from("<7d", content, at)
                struct.pack_into("<7d", moved, at, *_scaled(numbers, similarity))
                at += 56
    _require_end(at, len(content))
    return bytes(moved)


def _binary_frames(content: bytes, similarity: Similarity) -> bytes:
    moved, at = bytearray(content), 8
    (count,) = struct.unpack_from("<Q", content)
    for _ in range(count):
        numbers = struct.unpack_from("<7d", content, at + 8)
        struct.pack_into("<7d", moved, at + 8, *moved_numbers(numbers, similarity))
        (data,) = struct.unpack_from("<I", content, at + 64)
        at += 68 + 16 * data
    _require_end(at, len(content))
    return bytes(moved)


def require_no_binary(folder: Path) -> None:
    """Makes sure that a text model will be what programs read from a folder: they take binary files first.

    Raises:
        DatasetError: There are such.
    """
    names = [f"{name}.bin" for name in ("cameras", "images", "points3D", *RIG_FILES)]
    there = [name for name in names if (folder / name).exists()]
    if there:
        raise DatasetError(
            f"{folder / there[0]} would be read before the model as text that is to be written beside it.",
            "Name another folder: `--out OTHER`",
        )


def write_moved_colmap(model: Path, similarity: Similarity, folder: Path) -> None:
    """Writes a copy of a model, text or binary as it is, in the frame that a similarity leads to.

    Tracks, colours, errors and points of pictures stay as they are. Rigs and frames of COLMAP 4 move along; a
    model without them gets such as COLMAP makes for it, each camera a rig of its own.

    Args:
        model: Folder of ``cameras``, ``images`` and, where there are points, ``points3D``.
        similarity: From the model to the map.
        folder: To write.

    Raises:
        DatasetError: A file is missing, cut off or malformed, or the folder is the model's own.
    """
    if folder.resolve() == model.resolve():
        raise DatasetError(f"{folder} is the model that is to be moved.", "Name another `--out`.")
    ending = "bin" if (model / "images.bin").is_file() else "txt"
    move_images, move_points = (
        (_binary_images, _binary_points) if ending == "bin" else (_text_images, _text_points)
    )
    if ending == "txt":
        require_no_binary(folder)
    make_folder(folder)
    for name, move in (("images", move_images), ("points3D", move_points)):
        file = model / f"{name}.{ending}"
        if name == "images" or file.is_file():
            with LayoutGuard(str(file), f"{name} of a COLMAP model"):
                write_bytes(folder / file.name, _moved(file, move, similarity))
    _write_rigs(model, similarity, folder, ending)
    shutil.copyfile(model / f"cameras.{ending}", folder / f"cameras.{ending}")


def _write_rigs(model: Path, similarity: Similarity, folder: Path, ending: str) -> None:
    """Writes rigs and frames: those left in the folder by another program would overrule the poses."""
    files = [model / f"{name}.{ending}" for name in RIG_FILES]
    if all(file.is_file() for file in files):
        for file, move in zip(files, movers(ending), strict=True):
            with LayoutGuard(str(file), f"{file.stem} of a COLMAP model"):
                write_bytes(folder / file.name, _moved(file, move, similarity))
        return
    images = (folder / f"images.{ending}").read_bytes()
    for file, made in zip(files, lone_cameras(posed_images(images, ending), ending), strict=True):
        write_bytes(folder / file.name, made)


def _moved(file: Path, move: Callable[[bytes, Similarity], bytes], similarity: Similarity) -> bytes:
    try:
        return move(file.read_bytes(), similarity)
    except OSError as error:
        raise DatasetError(f"{file} cannot be read: {error.strerror}.") from error
    except struct.error as error:
        raise DatasetError(f"{file} is cut off.", "Copy it again.") from error


def _text_images(content: bytes, similarity: Similarity) -> bytes:
    lines, is_points = [], False
    for line in content.decode("utf-8-sig").split("\n"):
        if line.lstrip().startswith("#") or not (line.strip() or is_points):
            lines.append(line)
        elif is_points:
            lines.append(line)
            is_points = False
        else:
            words = line.split(maxsplit=8)
            moved = moved_numbers([float(word) for word in words[1:8]], similarity)
            lines.append(" ".join([words[0], *map(repr, moved), words[8]]))
            is_points = True
    return "\n".join(lines).encode("utf-8")


def _text_points(content: bytes, similarity: Similarity) -> bytes:
    lines = []
    for line in content.decode("utf-8-sig").split("\n"):
        if line.strip() and not line.lstrip().startswith("#"):
            number, x, y, z, *rest = line.split(maxsplit=4)
            place = similarity.points(np.array([[float(x), float(y), float(z)]]))[0]
            line = " ".join([number, *(repr(float(v)) for v in place), *rest])
        lines.append(line)
    return "\n".join(lines).encode("utf-8")


def _binary_images(content: bytes, similarity: Similarity) -> bytes:
    moved, at = bytearray(content), 8
    (count,) = struct.unpack_from("<Q", content)
    for _ in range(count):
        numbers = struct.unpack_from("<7d", content, at + 4)
        struct.pack_into("<7d", moved, at + 4, *moved_numbers(numbers, similarity))
        at = content.index(b"\0", at + 64) + 1
        (points,) = struct.unpack_from("<Q", content, at)
        at += 8 + points * BYTES_PER_POINT
    return bytes(moved)


def _binary_points(content: bytes, similarity: Similarity) -> bytes:
    moved, at = bytearray(content), 8
    (count,) = struct.unpack_from("<Q", content)
    for _ in range(count):
        place = similarity.points(np.array([struct.unpack_from("<3d", content, at + 8)]))[0]
        struct.pack_into("<3d", moved, at + 8, *map(float, place))
        (length,) = struct.unpack_from("<Q", content, at + 43)
        at += 51 + length * BYTES_PER_TRACK
    return bytes(moved)
