"""COLMAP models moved by a similarity: poses and points, everything else as it was."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lodbench.datasets.exchange.colmap import require_no_binary
from lodbench.datasets.exchange.colmap_rigs import (
    BYTES_PER_POINT,
    RIG_FILES,
    lone_cameras,
    moved_numbers,
    movers,
    posed_images,
)
from lodbench.datasets.exchange.posed import LayoutGuard
from lodbench.errors import DatasetError
from lodbench.geometry.similarity import Similarity
from lodbench.storage import make_folder, write_bytes

_BYTES_PER_TRACK = 8


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
        at += 51 + length * _BYTES_PER_TRACK
    return bytes(moved)
