"""Poses as lines: LoD-Loc's and visuallocalization.net's, TUM's, and folders of 4 x 4 matrices."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from lodbench.datasets.exchange.posed import (
    FoundPose,
    Place,
    content,
    inverted,
    read_text,
    require_plain_names,
)
from lodbench.datasets.pose_text import format_pose, lines_to_text, parse_pose
from lodbench.errors import LodbenchError
from lodbench.geometry import Pose
from lodbench.storage import write_text


def read_lines(path: Path) -> Iterator[FoundPose]:
    """Yields poses of lines ``name qw qx qy qz tx ty tz``, world to camera.

    Raises:
        DatasetError: A line is malformed.
    """
    for where, line in content(path):
        with Place(where, "name qw qx qy qz tx ty tz"):
            # From the right: a name may hold spaces.
            name, *numbers = line.rsplit(maxsplit=7)
            pose = parse_pose(numbers)
        yield FoundPose(name, where, pose)


def write_lines(images: Sequence[FoundPose], path: Path) -> None:
    """Writes such lines; reading them gives the same translations to the bit, and rotations to rounding.

    Raises:
        DatasetError: A name has a space or occurs twice.
    """
    require_plain_names([image.name for image in images], " \t\r\n", "pose lines")
    write_text(path, lines_to_text(format_pose(image.name, image.pose) for image in images))


def read_matrices(path: Path) -> Iterator[FoundPose]:
    """Yields the poses of a folder of ``<stem>_pose.txt`` or ``<stem>.txt``, 4 x 4, camera to world.

    Raises:
        DatasetError: A file is no such matrix.
    """
    for file in sorted(path.glob("*.txt")):
        with Place(str(file), "four rows of four numbers, camera to world"):
            rows = [[float(word) for word in line.split()] for _, line in content(file)]
            if [len(row) for row in rows] != [4, 4, 4, 4]:
                raise LodbenchError("not four rows of four numbers")
            if not np.allclose(rows[3], [0, 0, 0, 1]):
                raise LodbenchError("the last row is not 0 0 0 1")
            pose = inverted(Pose.from_matrix(np.array(rows)))
        yield FoundPose(file.stem.removesuffix("_pose"), str(file), pose)


_NAME_COMMENT = re.compile(r"^# (\S+) is (.+?)\r?$", re.MULTILINE)


def read_tum(path: Path) -> Iterator[FoundPose]:
    """Yields poses; the name is the timestamp as written, or what a comment says it is.

    Raises:
        DatasetError: A line is malformed.
    """
    names = dict(_NAME_COMMENT.findall(read_text(path)))
    for where, line in content(path):
        with Place(where, "timestamp tx ty tz qx qy qz qw, camera to world"):
            words = line.split()
            if len(words) != 8:
                raise LodbenchError(f"{len(words)} values instead of 8")
            pose = inverted(parse_pose([words[7], *words[4:7], *words[1:4]]))
        yield FoundPose(names.get(words[0], words[0]), where, pose)


def write_tum(images: Sequence[FoundPose], path: Path) -> None:
    """Writes a trajectory with the images' numbers as timestamps, in their order.

    Raises:
        DatasetError: A name occurs twice.
    """
    require_plain_names([image.name for image in images], "\r\n", "TUM comments")
    lines = ["# timestamp tx ty tz qx qy qz qw, camera to world"]
    lines += [f"# {number} is {image.name}" for number, image in enumerate(images)]
    for number, image in enumerate(images):
        w, x, y, z = inverted(image.pose).quat_wxyz
        values = [*(float(v) for v in image.pose.center), x, y, z, w]
        lines.append(" ".join([str(number), *map(repr, values)]))
    write_text(path, lines_to_text(lines))
