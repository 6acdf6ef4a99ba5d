"""TUM trajectories: ``timestamp tx ty tz qx qy qz qw``, camera to world.

The format has no names. Written files say in comments which image each timestamp is, and those are
read back; other programs skip them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from lodbench.datasets.exchange.posed import (
    FoundPose,
    Place,
    content,
    inverted,
    read_text,
    require_plain_names,
)
from lodbench.datasets.pose_text import lines_to_text, parse_pose
from lodbench.errors import LodbenchError
from lodbench.storage import write_text

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
