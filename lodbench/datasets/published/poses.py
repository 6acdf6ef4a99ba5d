"""Poses and cameras of one split, by image name, from any of the files that the releases come with."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import TypeVar

from lodbench.datasets.codes import POSES_DISAGREE, STEM_AMBIGUOUS
from lodbench.datasets.exchange.colmap import read_colmap
from lodbench.datasets.exchange.posed import FoundPose
from lodbench.datasets.photo_metadata import read_photo_metadata
from lodbench.datasets.pose_files import read_pose_file
from lodbench.datasets.pose_text import read_cameras
from lodbench.errors import DatasetError, LodbenchError
from lodbench.findings import Findings
from lodbench.geometry import Camera, Pose
from lodbench.storage.json_text import parse_json

T = TypeVar("T")

# Two files that were written from one pose agree to this.
_SAME_M, _SAME_ROTATION = 1e-3, 1e-5
_VISUAL_LANDMARK_LINES = 3


def read_names(path: Path, scene: str, keys: tuple[str, ...]) -> list[str]:
    """Returns the image names of one scene in a split file.

    Args:
        path: A JSON ``{"train": {scene: [names]}, "val": {...}}``, or text whose lines start with a name.
        scene: Name of the scene's folder.
        keys: Keys of the JSON to take, in order; the released test files say ``val``.

    Raises:
        DatasetError: The file cannot be read or does not list the scene.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        if path.suffix != ".json":
            has_head = text.startswith("Visual Landmark")
            lines = text.splitlines()[_VISUAL_LANDMARK_LINES if has_head else 0 :]
            names = [line.split()[0] for line in lines if line.strip()]
        else:
            parts = parse_json(text)
            names = [name for key in keys for name in parts.get(key, {}).get(scene, ())]
        names = [PurePosixPath(name).name for name in names]
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise DatasetError(
            f"{path} is not a list of queries: {error}.", f"Needed: {keys[0]}, {scene}."
        ) from error
    if not names:
        raise DatasetError(f"{path} lists no query of {scene}.", f"Looked for: {', '.join(keys)}.")
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise DatasetError(f"{path} lists {repeated[0]} twice ({len(repeated)} names repeat).")
    return names


def read_many(path: Path) -> dict[str, list[FoundPose]]:
    """Returns the poses of a file by base name, or of a folder by stem; several where it has several.

    ``query/`` before a name is dropped; images of the mapping (``db/``) are left out.

    Raises:
        DatasetError: As for ``read_pose_file``.
    """
    kind = "c2w" if path.is_dir() else "colmap" if path.name == "images.txt" else "lines"
    found: dict[str, list[FoundPose]] = {}
    for pose in read_pose_file(path, kind)[1]:
        name = PurePosixPath(pose.name)
        if name.parts[:1] != ("db",):
            found.setdefault(name.name, []).append(pose)
    return found


def only_ones(found: dict[str, list[FoundPose]]) -> dict[str, Pose]:
    """Returns poses of which there may be one per name.

    Raises:
        DatasetError: A name occurs twice; the message has both places.
    """
    for name, poses in found.items():
        if len(poses) > 1:
            raise DatasetError(
                f"{poses[1].where}: {name} has a pose already, from {poses[0].where}.", "Remove one."
            )
    return {name: poses[0].pose for name, poses in found.items()}


def stems_of(name: str) -> tuple[str, ...]:
    """Returns the stems under which per-image files of an image may be stored, the likeliest first.

    The releases' code writes poses under the name up to its first dot, and reads them under that name
    up to ``_img``.
    """
    stem = name.split(".")[0]
    return tuple(dict.fromkeys((stem, stem.split("_img")[0])))


def by_stem(values: dict[str, T], names: Iterable[str], where: Path, findings: Findings) -> dict[str, T]:
    """Returns the values of per-image files by image name.

    Args:
        values: By stem.
        names: Image names.
        where: The folder, for messages.
        findings: Receives stems that fit several images.
    """
    owner = {name: stem for name in names for stem in reversed(stems_of(name)) if stem in values}
    for stem, count in Counter(owner.values()).items():
        if count > 1:
            twins = [name for name in owner if owner[name] == stem]
            findings.add(STEM_AMBIGUOUS, twins[1], f"{where.name}/{stem} fits {' and '.join(twins)}")
    return {name: values[stem] for name, stem in owner.items()}


def prefer_per_image(
    text: dict[str, Pose], per_image: dict[str, Pose], split: str, findings: Findings
) -> dict[str, Pose]:
    """Returns the poses of a text file, replaced where a per-image file holds another one.

    The released example has a text line that repeats another image's pose; its matrix is right.
    """
    merged = dict(text)
    for name, pose in per_image.items():
        if name in text:
            distance = float(abs(text[name].center - pose.center).max())
            turn = float(abs(text[name].rotation - pose.rotation).max())
            if distance > _SAME_M or turn > _SAME_ROTATION:
                findings.add(POSES_DISAGREE, f"{split}/{name}", f"{distance:.3g} m apart")
                merged[name] = pose
        else:
            merged[name] = pose
    return merged


def read_split_cameras(
    path: Path, names: Iterable[str], images: dict[str, Path], findings: Findings
) -> dict[str, Camera]:
    """Returns the cameras of a split by image name.

    Args:
        path: ``intrinsic.txt``, a folder of 3 x 4 matrices, or COLMAP's ``cameras.txt``.
        names: The image names.
        images: Photos by name: a matrix does not state its picture's size.
        findings: As for ``by_stem``.

    Raises:
        DatasetError: A file is malformed.
    """
    if path.is_dir():
        matrices = {file.stem.removesuffix("_intrinsic"): file for file in sorted(path.glob("*.txt"))}
        chosen = by_stem(matrices, names, path, findings)
        return {name: _matrix_camera(file, images[name]) for name, file in chosen.items() if name in images}
    if path.name == "cameras.txt":
        return _colmap_cameras(path)
    return read_cameras(path)


def _matrix_camera(path: Path, image: Path) -> Camera:
    try:
        rows = [[float(word) for word in line.split()] for line in path.read_text().splitlines()]
        (fx, skew, cx, _), (_, fy, cy, _), (*_, one, _) = rows
        if skew != 0 or one != 1:
            raise LodbenchError("a camera matrix without skew ends in 0 0 1 0")
        header = read_photo_metadata(image)
        return Camera(header.width, header.height, fx, fy, cx, cy)
    except DatasetError:
        raise
    except (LodbenchError, OSError, ValueError) as error:
        raise DatasetError(
            f"{path}: {str(error).rstrip('.')}.", "Expected: 3 x 4, K and a zero column."
        ) from error


def _colmap_cameras(path: Path) -> dict[str, Camera]:
    """Returns the cameras of a COLMAP text model by image base name."""
    images = read_colmap(path.with_name("images.txt"))
    return {PurePosixPath(image.name).name: image.camera for image in images if image.camera is not None}
