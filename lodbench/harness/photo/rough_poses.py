"""Rough poses from a file, by the photos' names: for photos that do not state where they were taken."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lodbench.datasets.declared_crs import brought
from lodbench.datasets.pose_files import read_pose_file
from lodbench.harness.photo.flight_inputs import poses_by_photo
from lodbench.harness.photo.request import RoughPoses


def read_rough_poses(path: Path, photos: Sequence[Path], crs: str | None) -> RoughPoses:
    """Returns the rough poses of photos.

    Args:
        path: Poses in any known format; those that declare a reference system are brought into the city's.
        photos: The files.
        crs: Of the city; None where nobody knows it.

    Raises:
        DatasetError: The file cannot be read, or has a pose of none of the photos.
    """
    names = {name for photo in photos for name in (photo.name, photo.stem)}
    found, notes = brought(read_pose_file(path, "auto", names)[1], crs)
    return RoughPoses(path, poses_by_photo(path, found, photos), notes)
