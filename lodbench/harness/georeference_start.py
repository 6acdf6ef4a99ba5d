"""Where a reconstruction is, roughly: what its photos state, rough poses, or a similarity found before."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from lodbench.datasets.own import find_photo, shared_files
from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.datasets.pose_text import FoundPose, LayoutGuard, read_json
from lodbench.errors import DatasetError, LodbenchError
from lodbench.geometry import Pose
from lodbench.geometry.similarity import FEWEST_POSES, Similarity, fit_similarity
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import place_notes
from lodbench.photos.metadata import PhotoMetadata, read_photo_metadata
from lodbench.photos.pose import HeightOptions, pose_from_photo

# What rough places and directions are off by, each photo by itself, metres and degrees.
ROUGH_M, ROUGH_DEG = np.array([3.0, 3.0, 5.0]), 5.0


@dataclass(frozen=True, slots=True, eq=False)
class RoughStart:
    """Where a reconstruction is, roughly.

    Attributes:
        similarity: From the model to the city's coordinates.
        source: Where it came from, in words.
        notes: What the reader should know of it.
    """

    similarity: Similarity
    source: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _StatedPoses:
    """What photos say: rough poses by name, what else those state, and why others give none."""

    poses: dict[str, Pose]
    photos: list[PhotoMetadata]
    faults: list[LodbenchError]


class Rough(Protocol):
    """What is known of where a reconstruction is: see ``GeoreferenceRequest``."""

    @property
    def start(self) -> Path | None: ...  # noqa: D102
    @property
    def images(self) -> Path | None: ...  # noqa: D102
    @property
    def heights(self) -> HeightOptions: ...  # noqa: D102


def rough_start(request: Rough, images: Sequence[FoundPose], frame: MapFrame | None) -> RoughStart:
    """Returns the similarity to start from.

    Args:
        request: Where rough poses are.
        images: Of the model, in its own frame.
        frame: The city's coordinates; None where nobody knows them on Earth.

    Raises:
        LodbenchError: Too few images have a rough pose, or a file cannot be read.
    """
    if request.start is not None and request.start.suffix == ".json":
        values = read_json(request.start)
        if "similarity" in values:
            found = _stated_similarity(values["similarity"], request.start)
            return RoughStart(found, f"the similarity in {request.start}")
    if request.start is not None:
        listed, notes = brought(
            read_pose_file(request.start, "auto")[1], None if frame is None else frame.crs
        )
        known, source = _by_name(images, listed), str(request.start)
        _require_enough(len(known), len(images), source, [])
    else:
        stated = _stated_by_photos(request, images, frame)
        known, source = stated.poses, "what the photos state"
        _require_enough(len(known), len(images), source, stated.faults)
        notes = place_notes(frame, stated.photos, request.heights)
    mine = {image.name: image.pose for image in images}
    sigmas = np.broadcast_to(ROUGH_M, (len(known), 3)), np.full(len(known), ROUGH_DEG)
    fitted = fit_similarity([mine[name] for name in known], list(known.values()), *sigmas)
    away = float(np.median(fitted.distances_m))
    words = f"{source}: {len(known)} cameras, {away:.1f} m apart in the median"
    return RoughStart(fitted.similarity, words, notes)


def _require_enough(usable: int, count: int, source: str, faults: Sequence[LodbenchError]) -> None:
    if usable >= FEWEST_POSES:
        return
    first = f"; the first without one: {faults[0].message.rstrip('.')}" if faults else ""
    hint = "Give `--images DIR` with the drone's photos, or `--start FILE` with rough poses."
    if faults:
        # What a photo lacks can be given to localize alone; how heights are meant, here too.
        own = faults[0].hint if "lodbench localize takes" not in faults[0].hint else ""
        hint = own or "Give `--start FILE` with rough poses."
    raise DatasetError(
        f"{usable} of the model's {count} cameras have a rough place ({source}), and {FEWEST_POSES} are "
        f"needed{first}.",
        hint,
    )


def _by_name(images: Sequence[FoundPose], listed: Sequence[FoundPose]) -> dict[str, Pose]:
    """Returns the rough poses of images, by name: the same, or that without folders where one has it."""
    whole = {pose.name: pose.pose for pose in listed}
    named = Counter(Path(image.name).name for image in images)
    bare: dict[str, list[Pose]] = defaultdict(list)
    for pose in listed:
        bare[Path(pose.name).name].append(pose.pose)
    known = {}
    for image in images:
        same = bare[Path(image.name).name]
        if image.name in whole:
            known[image.name] = whole[image.name]
        elif len(same) == named[Path(image.name).name] == 1:
            known[image.name] = same[0]
    return known


def _stated_similarity(values: object, path: Path) -> Similarity:
    with LayoutGuard(str(path), "a similarity: scale, rotation, translation"):
        if not isinstance(values, Mapping):
            raise ValueError("it is no object")
        scale, turn = float(values["scale"]), np.array(values["rotation"], dtype=np.float64)
        shift = np.array(values["translation"], dtype=np.float64)
        if scale <= 0 or turn.shape != (3, 3) or shift.shape != (3,):
            raise ValueError("its scale is no positive number, or a shape is wrong")
        return Similarity(scale, Pose.from_matrix(np.column_stack([turn, shift])).rotation, shift)


def _stated_by_photos(request: Rough, images: Sequence[FoundPose], frame: MapFrame | None) -> _StatedPoses:
    """Returns where photos say they were taken, for those that say it."""
    if request.images is None:
        raise DatasetError(
            "Nobody says where the model is, roughly.",
            "Give `--images DIR` with the drone's photos, or `--start FILE` with rough poses.",
        )
    if frame is None:
        raise DatasetError(
            "The city names no reference system, so GPS means nothing in it.",
            "Name it with `--crs`, or give `--start FILE` with rough poses.",
        )
    stated = _StatedPoses({}, [], [])
    paths = [find_photo(request.images, image.name) for image in images]
    shared = shared_files(paths)
    for image, path in zip(images, paths, strict=True):
        if path is not None:
            try:
                if path in shared:
                    raise DatasetError(
                        f"{path} may be of several of the model's images.",
                        "Keep the folders that their names have below `--images`.",
                    )
                photo = read_photo_metadata(path)
                stated.poses[image.name] = pose_from_photo(photo, frame, request.heights)
                stated.photos.append(photo)
            except LodbenchError as fault:
                stated.faults.append(fault)
    return stated
