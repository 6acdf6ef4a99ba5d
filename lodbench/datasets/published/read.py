"""One split of a published dataset as entries and truth, nothing dropped without a finding."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np

from lodbench.datasets import faults
from lodbench.datasets.exchange.colmap import read_colmap
from lodbench.datasets.pose_files import read_pose_file
from lodbench.datasets.pose_text import FoundPose, read_cameras
from lodbench.datasets.published.layout import MASK_FOLDERS, SplitFiles
from lodbench.datasets.query import Entry
from lodbench.errors import DatasetError, LodbenchError
from lodbench.findings import Findings
from lodbench.geometry import Camera, Pose, wrap_deg
from lodbench.photos.files import mask_names
from lodbench.photos.metadata import read_photo_metadata
from lodbench.photos.pictures import read_picture
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
    by_name: dict[str, list[FoundPose]] = {}
    for pose in read_pose_file(path, kind)[1]:
        name = PurePosixPath(pose.name)
        if name.parts[:1] != ("db",):
            by_name.setdefault(name.name, []).append(pose)
    return by_name


def only_ones(by_name: dict[str, list[FoundPose]]) -> dict[str, Pose]:
    """Returns poses of which there may be one per name.

    Raises:
        DatasetError: A name occurs twice; the message has both places.
    """
    for name, poses in by_name.items():
        if len(poses) > 1:
            raise DatasetError(
                f"{poses[1].where}: {name} has a pose already, from {poses[0].where}.", "Remove one."
            )
    return {name: poses[0].pose for name, poses in by_name.items()}


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
            findings.add(faults.STEM_AMBIGUOUS, twins[1], f"{where.name}/{stem} fits {' and '.join(twins)}")
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
                findings.add(faults.POSES_DISAGREE, f"{split}/{name}", f"{distance:.3g} m apart")
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


# Synthetic views: easting@northing@height@pitch@yaw@roll, each cut to a whole number.
_SYNTHETIC_NAME = re.compile(r"(-?\d+)@(-?\d+)@(-?\d+)@(-?\d+)@(-?\d+)@(-?\d+)")
# Share of a mask's pixels that are black or white.
_MASK_SHARE = 0.95


@dataclass(frozen=True, slots=True)
class SplitContent:
    """The queries of one split, as its files have them; ``truth`` by ``Entry.key``."""

    entries: tuple[Entry, ...]
    truth: dict[str, Pose]


def read_split(files: SplitFiles, findings: Findings) -> SplitContent:
    """Returns the queries of a split.

    Raises:
        DatasetError: A file is malformed, or repeats a name that may occur once.
    """
    split = files.spec.name
    assert files.truth is not None  # noqa: S101 - the caller has made sure
    assert files.cameras is not None  # noqa: S101 - likewise
    poses = only_ones(read_many(files.truth))
    images = {path.name: path for path in sorted(files.images.iterdir())} if files.images else {}
    listed = _listed(files)
    # A folder of matrices knows stems only: then the photos name the queries.
    names = listed if listed is not None else list(images if files.truth.is_dir() and images else poses)
    truth = _truth(files, poses, names, findings)
    known = {name: truth[name] for name in names if name in truth}
    for name in truth:
        if name not in known:
            findings.add(faults.NOT_IN_SPLIT, f"{split}/{name}")
    priors = _priors(files, names, findings)
    cameras = read_split_cameras(files.cameras, names, images, findings)
    drawn = images if files.images is not None and files.images.name == "query" and _are_masks(images) else {}
    entries = tuple(
        Entry(
            name=name,
            split=split,
            camera=cameras.get(name),
            prior=priors[name][0] if name in priors else None,
            image=images.get(name),
            mask=_mask(files, name) or drawn.get(name),
            hypotheses=tuple(priors.get(name, ())),
        )
        for name in names
    )
    _report(entries, known, findings)
    return SplitContent(entries, {f"{split}/{name}": pose for name, pose in known.items()})


def _listed(files: SplitFiles) -> list[str] | None:
    if files.names is None:
        return None
    keys = ("val", "test") if files.spec.is_test else ("train", "val")
    return read_names(files.names, files.folder.name, keys)


def _truth(
    files: SplitFiles, poses: dict[str, Pose], names: Iterable[str], findings: Findings
) -> dict[str, Pose]:
    assert files.truth is not None  # noqa: S101 - the caller has made sure
    if files.truth.is_dir():
        return by_stem(poses, names, files.truth, findings)
    if files.truth_folder is None:
        return poses
    matrices = by_stem(only_ones(read_many(files.truth_folder)), names, files.truth_folder, findings)
    return prefer_per_image(poses, matrices, files.spec.name, findings)


def _priors(files: SplitFiles, names: Iterable[str], findings: Findings) -> dict[str, list[Pose]]:
    """Returns all prior poses of each query."""
    if files.priors is None:
        return {}
    if files.other_priors:
        others = ", ".join(path.name for path in files.other_priors)
        detail = f"{files.priors.name}, not {others} (dataset.prior_file=NAME)"
        findings.add(faults.FILE_CHOSEN, files.spec.name, detail)
    priors = {name: [pose.pose for pose in poses] for name, poses in read_many(files.priors).items()}
    return by_stem(priors, names, files.priors, findings) if files.priors.is_dir() else priors


def _mask(files: SplitFiles, name: str) -> Path | None:
    for folder in MASK_FOLDERS:
        for file in mask_names(name):
            if (files.folder / folder / file).is_file():
                return files.folder / folder / file
    return None


def _are_masks(images: dict[str, Path]) -> bool:
    """Tells by the first whether pictures in the photos' place are masks, as LoD-Loc v2's code has them."""
    picture = next((decoded for path in images.values() if (decoded := read_picture(path)) is not None), None)
    # Nearly all of a mask is black or white, however a JPEG blurred its outlines; no photo is.
    return picture is not None and float(np.mean((picture < 32) | (picture > 223))) > _MASK_SHARE


def _report(entries: tuple[Entry, ...], truth: dict[str, Pose], findings: Findings) -> None:
    by_pose: dict[bytes, str] = {}
    for entry in entries:
        lacks = {
            faults.NO_TRUTH: entry.name not in truth,
            faults.NO_PRIOR: entry.prior is None,
            faults.NO_CAMERA: entry.camera is None,
            faults.NO_IMAGE: entry.image is None,
            faults.SEVERAL_PRIORS: len(entry.hypotheses) > 1,
        }
        for code, is_so in lacks.items():
            if is_so:
                findings.add(code, entry.key)
        if entry.name in truth:
            pose = truth[entry.name]
            twin = by_pose.setdefault(pose.cam_from_world.tobytes(), entry.key)
            if twin != entry.key:
                findings.add(faults.SAME_POSE, entry.key, f"that of {twin}")
            _check_name(entry, pose, findings)


def _check_name(entry: Entry, pose: Pose, findings: Findings) -> None:
    """Compares the height and attitude in a synthetic image's name with its pose."""
    match = _SYNTHETIC_NAME.match(entry.name)
    if match is None:
        return
    height, pitch, yaw, roll = (int(text) for text in match.groups()[2:])
    angles = pose.euler
    turns = (angles.pitch_deg - pitch, angles.yaw_deg - yaw, angles.roll_deg - roll)
    # Numbers in names are cut off, so they are wrong by less than 1; 0.01 is for rounding.
    if abs(pose.center[2] - height) > 1.01 or any(abs(wrap_deg(turn)) > 1.01 for turn in turns):
        worst = max(math.fabs(wrap_deg(turn)) for turn in turns)
        detail = f"{abs(pose.center[2] - height):.1f} m, {worst:.1f} deg off"
        findings.add(faults.NAME_DISAGREES, entry.key, detail)
