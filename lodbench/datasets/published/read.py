"""One split of a published dataset as entries and truth, nothing dropped without a finding."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lodbench.datasets.codes import (
    FILE_CHOSEN,
    NAME_DISAGREES,
    NO_CAMERA,
    NO_IMAGE,
    NO_PRIOR,
    NO_TRUTH,
    NOT_IN_SPLIT,
    SAME_POSE,
    SEVERAL_PRIORS,
)
from lodbench.datasets.photo_files import mask_names
from lodbench.datasets.pictures import read_picture
from lodbench.datasets.published.layout import SplitFiles
from lodbench.datasets.published.poses import (
    by_stem,
    only_ones,
    prefer_per_image,
    read_many,
    read_names,
    read_split_cameras,
)
from lodbench.datasets.published.spec import MASK_FOLDERS
from lodbench.datasets.query import Entry
from lodbench.findings import Findings
from lodbench.geometry import Pose, wrap_deg

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
    found = only_ones(read_many(files.truth))
    images = {path.name: path for path in sorted(files.images.iterdir())} if files.images else {}
    listed = _listed(files)
    # A folder of matrices knows stems only: then the photos name the queries.
    names = listed if listed is not None else list(images if files.truth.is_dir() and images else found)
    truth = _truth(files, found, names, findings)
    known = {name: truth[name] for name in names if name in truth}
    for name in truth:
        if name not in known:
            findings.add(NOT_IN_SPLIT, f"{split}/{name}")
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
    files: SplitFiles, found: dict[str, Pose], names: Iterable[str], findings: Findings
) -> dict[str, Pose]:
    assert files.truth is not None  # noqa: S101 - the caller has made sure
    if files.truth.is_dir():
        return by_stem(found, names, files.truth, findings)
    if files.truth_folder is None:
        return found
    matrices = by_stem(only_ones(read_many(files.truth_folder)), names, files.truth_folder, findings)
    return prefer_per_image(found, matrices, files.spec.name, findings)


def _priors(files: SplitFiles, names: Iterable[str], findings: Findings) -> dict[str, list[Pose]]:
    """Returns all prior poses of each query."""
    if files.priors is None:
        return {}
    if files.other_priors:
        others = ", ".join(path.name for path in files.other_priors)
        detail = f"{files.priors.name}, not {others} (dataset.prior_file=NAME)"
        findings.add(FILE_CHOSEN, files.spec.name, detail)
    found = {name: [pose.pose for pose in poses] for name, poses in read_many(files.priors).items()}
    return by_stem(found, names, files.priors, findings) if files.priors.is_dir() else found


def _mask(files: SplitFiles, name: str) -> Path | None:
    for folder in MASK_FOLDERS:
        for file in mask_names(name):
            if (files.folder / folder / file).is_file():
                return files.folder / folder / file
    return None


def _are_masks(images: dict[str, Path]) -> bool:
    """Tells by the first whether pictures in the photos' place are masks, as LoD-Loc v2's code has them."""
    picture = next((found for path in images.values() if (found := read_picture(path)) is not None), None)
    # Nearly all of a mask is black or white, however a JPEG blurred its outlines; no photo is.
    return picture is not None and float(np.mean((picture < 32) | (picture > 223))) > _MASK_SHARE


def _report(entries: tuple[Entry, ...], truth: dict[str, Pose], findings: Findings) -> None:
    seen: dict[bytes, str] = {}
    for entry in entries:
        lacks = {
            NO_TRUTH: entry.name not in truth,
            NO_PRIOR: entry.prior is None,
            NO_CAMERA: entry.camera is None,
            NO_IMAGE: entry.image is None,
            SEVERAL_PRIORS: len(entry.hypotheses) > 1,
        }
        for code, is_so in lacks.items():
            if is_so:
                findings.add(code, entry.key)
        if entry.name in truth:
            pose = truth[entry.name]
            twin = seen.setdefault(pose.cam_from_world.tobytes(), entry.key)
            if twin != entry.key:
                findings.add(SAME_POSE, entry.key, f"that of {twin}")
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
        findings.add(NAME_DISAGREES, entry.key, detail)
