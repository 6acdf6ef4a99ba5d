"""References: posed pictures of the place, from any folder in the text layout."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from lodbench.datasets.inputs import Input
from lodbench.datasets.pose_text import read_cameras, read_poses
from lodbench.datasets.query import Dataset, Entry, Reference
from lodbench.errors import DatasetError

_POSE_FILES = ("poses.txt", "GT_pose.txt")
_IMAGE_FOLDERS = ("images", "Query_image", ".")
_HINT = "References are a folder of poses.txt, intrinsic.txt and images/, pictures named as the poses."


def read_references(folder: Path) -> tuple[Reference, ...]:
    """Returns the posed pictures of a folder, in the order of the poses; no picture is opened.

    Args:
        folder: Holds ``poses.txt`` or ``GT_pose.txt`` (world to camera, in the city's coordinates),
            ``intrinsic.txt``, and the pictures in ``images`` or ``Query_image`` or beside the poses.

    Raises:
        DatasetError: There are no poses, one has no camera or no picture, or its lens distorts.
    """
    if not folder.is_dir():
        raise DatasetError(f"{folder} is not a folder.", "Set dataset.references=FOLDER.")
    file = next((folder / name for name in _POSE_FILES if (folder / name).is_file()), None)
    poses = {} if file is None else read_poses(file)
    if not poses:
        raise DatasetError(f"The references in {folder} have no poses.", _HINT)
    cameras = read_cameras(folder / "intrinsic.txt")
    references = []
    for name, pose in poses.items():
        candidates = (folder / images / name for images in _IMAGE_FOLDERS)
        image = next((path for path in candidates if path.is_file()), None)
        if name not in cameras or image is None:
            lacking = "no camera in intrinsic.txt" if name not in cameras else "no picture"
            raise DatasetError(f"The reference {name} in {folder} has {lacking}.", _HINT)
        if cameras[name].distortion:
            raise DatasetError(
                f"The reference {name} in {folder} has a camera with lens distortion.",
                "Undistort the pictures first: lodbench dataset init does.",
            )
        references.append(Reference(name, image, cameras[name], pose))
    return tuple(references)


def with_inputs(dataset: Dataset, requires: Collection[str]) -> Dataset:
    """Returns a dataset with what a method requires of it made, where the dataset makes it on demand.

    Raises:
        LodbenchError: It cannot be made.
    """
    if Input.TEXTURED_MAP in requires and Input.TEXTURED_MAP in dataset.on_demand:
        dataset = replace(dataset, textured_map=dataset.on_demand[Input.TEXTURED_MAP]())
    if Input.REFERENCES in requires and Input.REFERENCES in dataset.on_demand:
        dataset = replace(dataset, references=read_references(dataset.on_demand[Input.REFERENCES]()))
    if Input.INSTANCES in requires and Input.INSTANCES in dataset.on_demand:
        folder = dataset.on_demand[Input.INSTANCES]()
        dataset = replace(dataset, entries=tuple(_labelled(entry, folder) for entry in dataset.entries))
    return dataset


def _labelled(entry: Entry, folder: Path) -> Entry:
    """Returns an entry with its labels of a folder of ``SPLIT/STEM.png``, if they are there."""
    file = folder / entry.split / f"{Path(entry.name).stem}.png"
    return replace(entry, instances=file) if file.is_file() else entry
