"""Which pose of a file belongs to which query, and whether the file's convention is the expected one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import PurePosixPath

import numpy as np

from lodbench.datasets.pose_files import is_number
from lodbench.datasets.pose_text import FoundPose, inverted
from lodbench.datasets.query import Entry
from lodbench.errors import DatasetError
from lodbench.evaluation.errors import pose_error
from lodbench.geometry import Pose

# A convention is suspected if reading the poses in another way brings them this many times closer.
_SUSPICIOUS = 10.0


@dataclass(frozen=True, slots=True)
class Matched:
    """Poses by ``Entry.key``, and what the reader should know."""

    poses: dict[str, Pose]
    notes: tuple[str, ...]


def match_poses(found: Sequence[FoundPose], entries: Sequence[Entry], format_name: str) -> Matched:
    """Returns the poses of some queries.

    A name means ``split/name``, else the image's file name, else, for formats that keep no ending
    (``c2w``, ``tum``), its stem; folders before it are dropped. TUM lines whose timestamps are no names
    are taken in the order of the queries if there are as many of both, which a note says.

    Raises:
        DatasetError: Two poses are for one query, a name may mean several queries, or none is known.
    """
    index = _index(entries, with_stems=format_name in ("c2w", "tum"))
    unknown = [pose for pose in found if not _candidates(index, pose.name)]
    if len(unknown) == len(found):
        if format_name == "tum" and len(found) == len(entries) and all(is_number(p.name) for p in found):
            return _by_order(found, entries)
        raise DatasetError(
            f"No name of the pose file is a query: the first is {found[0].name!r} ({found[0].where}).",
            f"The dataset's first query is {entries[0].key}." if entries else "The dataset has no queries.",
        )
    places: dict[str, str] = {}
    poses: dict[str, Pose] = {}
    for name, where, pose, *_ in found:
        keys = _candidates(index, name)
        if len(keys) > 1:
            raise DatasetError(f"{where}: {name} may be any of {', '.join(keys)}.", "Write split/name.")
        for key in keys:
            if key in places:
                raise DatasetError(f"{where}: {key} has a pose already, from {places[key]}.")
            places[key], poses[key] = where, pose
    loose = [pose for pose in found if pose.name not in index and _candidates(index, pose.name)]
    return Matched(poses, (*_note_loose(loose, index), *_note_unknown(unknown)))


def suspect_convention(
    poses: Mapping[str, Pose], reference: Mapping[str, Pose], has_quaternions: bool
) -> str | None:
    """Returns a sentence if poses read in another convention lie much closer to where they should.

    Nothing is mended: a benchmark that turns poses around by itself scores its own guess.

    Args:
        poses: Poses as read, by key.
        reference: True poses, or priors, by key.
        has_quaternions: Whether the order of a quaternion's components may be the fault.
    """
    shared = [key for key in poses if key in reference]
    if not shared:
        return None
    readings: dict[str, Callable[[Pose], Pose]] = {"in the other direction (camera to world)": inverted}
    if has_quaternions:
        readings["with the quaternion's real part last (x y z w)"] = _real_part_last
        readings["in the other direction and with the quaternion's real part last"] = lambda pose: inverted(
            _real_part_last(pose)
        )

    def medians(read: Callable[[Pose], Pose]) -> tuple[float, float]:
        distance_m, angle_deg = np.median(
            [pose_error(read(poses[key]), reference[key]) for key in shared], axis=0
        )
        # Turning a pose around puts the centre in one place whatever its rotation: then the angle tells.
        return round(float(distance_m), 3), float(angle_deg)

    given, _ = medians(lambda pose: pose)
    best = min(readings, key=lambda name: medians(readings[name]))
    other, _ = medians(readings[best])
    if given <= _SUSPICIOUS * other:
        return None
    return (
        f"the poses are {given:.1f} m from where they should be (median), but read {best} they are "
        f"{other:.1f} m from it: is the convention another? They were scored as given"
    )


def _real_part_last(pose: Pose) -> Pose:
    """Returns the pose whose quaternion was written x y z w and has been read w x y z."""
    x, y, z, w = pose.quat_wxyz
    return Pose.from_quaternion([w, x, y, z], pose.translation.tolist())


def _index(entries: Sequence[Entry], with_stems: bool) -> dict[str, list[str]]:
    index: dict[str, list[str]] = {}
    for entry in entries:
        names = [entry.key, entry.name]
        if with_stems:
            names += [str(PurePosixPath(name).with_suffix("")) for name in names]
        for name in dict.fromkeys(names):
            index.setdefault(name, []).append(entry.key)
    return index


def _candidates(index: Mapping[str, list[str]], name: str) -> list[str]:
    return index.get(name) or index.get(PurePosixPath(name).name, [])


def _by_order(found: Sequence[FoundPose], entries: Sequence[Entry]) -> Matched:
    times = [float(pose.name) for pose in found]
    if any(b <= a for a, b in pairwise(times)):
        raise DatasetError("The timestamps do not increase, and they are no names of queries.")
    poses = {entry.key: pose.pose for entry, pose in zip(entries, found, strict=True)}
    return Matched(poses, ("the timestamps are no names: poses were taken in the order of the queries",))


def _note_loose(loose: Sequence[FoundPose], index: Mapping[str, list[str]]) -> tuple[str, ...]:
    if not loose:
        return ()
    first = loose[0].name
    example = f"{first} as {_candidates(index, first)[0]}"
    return (f"{len(loose)} of the file's names were taken by their file name alone: {example}",)


def _note_unknown(unknown: Sequence[FoundPose]) -> tuple[str, ...]:
    if not unknown:
        return ()
    names = ", ".join(pose.name for pose in unknown[:3]) + (", ..." if len(unknown) > 3 else "")
    return (f"{len(unknown)} of the file's names are no query and were left out: {names}",)
