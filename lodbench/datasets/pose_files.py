"""Anybody's poses: four text formats, read into world-to-camera poses with the place each stood at.

=======  ==============================================================  ===============
format   layout                                                          stored as
=======  ==============================================================  ===============
lines    ``name qw qx qy qz tx ty tz`` (visuallocalization.net)          world to camera
c2w      a folder of ``<stem>_pose.txt`` or ``<stem>.txt``, 4 x 4         camera to world
colmap   ``images.txt``: two lines per image, the second is not read     world to camera
tum      ``timestamp tx ty tz qx qy qz qw``                              camera to world
=======  ==============================================================  ===============
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lodbench.datasets.pose_text import parse_pose
from lodbench.errors import ConfigError, DatasetError, LodbenchError, nearest_names
from lodbench.geometry import Pose


class FoundPose(NamedTuple):
    """A pose of a file: the name as written, the file and line it stood at, and the pose."""

    name: str
    where: str
    pose: Pose


def read_pose_file(path: Path, format_name: str, known: Collection[str] = ()) -> tuple[str, list[FoundPose]]:
    """Returns the format and the poses of a file or folder, in file order.

    Args:
        path: A file, or for ``c2w`` a folder.
        format_name: ``lines``, ``c2w``, ``colmap``, ``tum``, or ``auto`` to tell by the content.
        known: Names of queries: a line that starts with one is no TUM line, even if it is a number.

    Raises:
        ConfigError: The format has no such name.
        DatasetError: The file is missing, empty or of no known format, or a line holds no pose; the
            message names the line.
    """
    if format_name not in (*READERS, "auto"):
        raise ConfigError(
            f"format={format_name} is not known.", nearest_names(format_name, [*READERS, "auto"])
        )
    if not path.exists():
        raise DatasetError(f"The pose file {path} does not exist.", "Set poses=FILE.")
    kind = _guess(path, known) if format_name == "auto" else format_name
    if path.is_dir() != (kind == "c2w"):
        found = "a folder" if path.is_dir() else "a file"
        raise DatasetError(f"{path} is {found}.", "format=c2w reads a folder, all others a file.")
    poses = list(READERS[kind](path))
    if not poses:
        raise DatasetError(f"{path} holds no poses.", f"It was read with format={kind}.")
    return kind, poses


def inverted(pose: Pose) -> Pose:
    """Returns the pose that the same matrix means in the other direction."""
    return Pose.from_matrix(pose.world_from_cam)


def _read_lines(path: Path) -> Iterator[FoundPose]:
    for where, line in _content(path):
        with _At(where, "name qw qx qy qz tx ty tz"):
            # From the right: a name may hold spaces.
            name, *numbers = line.rsplit(maxsplit=7)
            pose = parse_pose(numbers)
        yield FoundPose(name, where, pose)


def _read_c2w(path: Path) -> Iterator[FoundPose]:
    for file in sorted(path.glob("*.txt")):
        with _At(str(file), "four rows of four numbers, camera to world"):
            rows = [[float(word) for word in line.split()] for _, line in _content(file)]
            if [len(row) for row in rows] != [4, 4, 4, 4]:
                raise LodbenchError("not four rows of four numbers")
            if not np.allclose(rows[3], [0, 0, 0, 1]):
                raise LodbenchError("the last row is not 0 0 0 1")
            pose = inverted(Pose.from_matrix(np.array(rows)))
        yield FoundPose(file.stem.removesuffix("_pose"), str(file), pose)


def _read_colmap(path: Path) -> Iterator[FoundPose]:
    lines = _content(path, keep_empty=True)
    for where, line in lines:
        if not line.strip():
            continue
        with _At(where, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"):
            words = line.split(maxsplit=9)
            if len(words) != 10:
                raise LodbenchError(f"{len(words)} values instead of 10")
            pose = parse_pose(words[1:8])
        # The line of the image's points, which may be empty.
        next(lines, None)
        yield FoundPose(words[9].strip(), where, pose)


def _read_tum(path: Path) -> Iterator[FoundPose]:
    for where, line in _content(path):
        with _At(where, "timestamp tx ty tz qx qy qz qw, camera to world"):
            words = line.split()
            if len(words) != 8:
                raise LodbenchError(f"{len(words)} values instead of 8")
            pose = inverted(parse_pose([words[7], *words[4:7], *words[1:4]]))
        yield FoundPose(words[0], where, pose)


READERS: dict[str, Callable[[Path], Iterator[FoundPose]]] = {
    "lines": _read_lines,
    "c2w": _read_c2w,
    "colmap": _read_colmap,
    "tum": _read_tum,
}


class _At:
    """Names the place and the layout in whatever goes wrong inside."""

    def __init__(self, where: str, layout: str) -> None:
        self._where, self._layout = where, layout

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, LodbenchError | ValueError) and not isinstance(error, DatasetError):
            reason = str(error).rstrip(".")
            raise DatasetError(f"{self._where}: {reason}.", f"Expected: {self._layout}") from error


def _content(path: Path, keep_empty: bool = False) -> Iterator[tuple[str, str]]:
    """Yields the lines of a file that are no comments, each with its place."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path} cannot be read: {error}.") from error
    for number, line in enumerate(text.split("\n"), start=1):
        if line.lstrip().startswith("#") or not (line.strip() or keep_empty):
            continue
        yield f"{path}, line {number}", line


def _guess(path: Path, known: Collection[str]) -> str:
    """Returns the format that the first line looks like."""
    if path.is_dir():
        return "c2w"
    where, line = next(_content(path), (str(path), ""))
    words = line.split()
    if len(words) >= 10 and words[0].isdigit() and words[8].isdigit():
        return "colmap"
    if len(words) == 8 and words[0] not in known and is_number(words[0]):
        return "tum"
    if len(words) >= 8:
        return "lines"
    raise DatasetError(f"{where} is of no known pose format.", f"Set format to one of {', '.join(READERS)}.")


def is_number(word: str) -> bool:
    """Tells whether a word reads as a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True
