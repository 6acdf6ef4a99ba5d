"""What photos are solved with: masks, pictures, rough poses and those of a reconstruction; what is unused."""

from __future__ import annotations

import shlex
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath, PurePosixPath
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.exchange.colmap import read_colmap
from lodbench.datasets.own import find_mask, find_photo, shared_files
from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.datasets.pose_text import FoundPose, LayoutGuard, read_json
from lodbench.errors import DatasetError, LodbenchError
from lodbench.geometry import Pose
from lodbench.geometry.similarity import FEWEST_POSES, Similarity, fit_similarity
from lodbench.harness.photo.prepare import PreparedPhoto, RoughPoses
from lodbench.methods.flight.relative_poses import FEWEST_PHOTOS
from lodbench.methods.georeference import ROUGH_DEG, ROUGH_M
from lodbench.photos.camera import undistorted
from lodbench.photos.files import PHOTO_SUFFIXES, copies_among, mask_name
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import place_notes
from lodbench.photos.metadata import PhotoMetadata, read_photo_metadata
from lodbench.photos.pictures import encoded, read_picture
from lodbench.photos.pose import HeightOptions, pose_from_photo
from lodbench.reporting.aligned_text import count_of
from lodbench.segmentation import no_wider
from lodbench.storage import write_bytes

# Masks of a flight are held at this width, pixels: half as much again as methods look at.
_MASK_WIDTH = 900
# Undistorted copies of photos, by whose features flights are tied together, are as wide as it looks, pixels.
_PICTURE_WIDTH = 2048


def names_of(photos: Sequence[Path]) -> list[str]:
    """Returns what photos are called: by their file names, with as many folders as tell them apart."""
    names = [photo.name for photo in photos]
    longest = max(len(photo.parts) for photo in photos)
    for depth in range(2, longest + 1):
        counts = Counter(names)
        names = [
            "/".join(photo.parts[-depth:]) if counts[name] > 1 else name
            for photo, name in zip(photos, names, strict=True)
        ]
    return names


def masks_of(photos: Sequence[Path], masks: Path | None) -> tuple[list[Path | None], dict[int, str]]:
    """Returns the mask of each photo, and why some photos are left out, by row.

    A mask that may be of two photos is of neither; a photo that is another's copy says nothing new.
    """
    mask_paths = [find_mask(masks, f"{photo.parent.name}/{photo.name}", photo) for photo in photos]
    copies, unreadable = copies_among(photos, mask_paths)
    reasons = copies | unreadable
    users: dict[Path | None, list[int]] = defaultdict(list)
    for row, mask in enumerate(mask_paths):
        if row not in copies:
            users[mask].append(row)
    for row, (photo, mask) in enumerate(zip(photos, mask_paths, strict=True)):
        if row in reasons:
            continue
        if masks is not None and mask is None:
            reasons[row] = f"{masks} holds no mask of it"
        elif mask is not None and len(users[mask]) > 1:
            others = ", ".join(str(photos[other]) for other in users[mask] if other != row)
            own = Path(photo.parent.name) / f"{photo.stem}.png"
            reasons[row] = f"the mask {mask} may be of {others} as well: name it {own}"
    return mask_paths, reasons


def poses_in_model(model: Path | None, photos: Sequence[Path]) -> dict[Path, Pose]:
    """Returns the poses of photos in a COLMAP model, by file; none without a model.

    A model's names may lack their endings, or have them in other letters. Where several photos or images have
    one name, folders tell them apart; what they do not is left out.

    Raises:
        DatasetError: The model cannot be read, or has none of the photos.
    """
    return {} if model is None else poses_by_photo(model, list(read_colmap(model)), photos)


def poses_by_photo(source: Path, listed: Sequence[FoundPose], photos: Sequence[Path]) -> dict[Path, Pose]:
    """Returns the poses of photos among those of a file or model, by photo; names as of ``poses_in_model``.

    Raises:
        DatasetError: There is none of any of the photos.
    """
    images: dict[str, list[FoundPose]] = defaultdict(list)
    for image in listed:
        images[_bare(PurePosixPath(image.name)).name].append(image)
    named = Counter(photo.name for photo in photos)
    matched: dict[Path, FoundPose] = {}
    for photo in photos:
        same = [image for image in images.get(photo.stem, []) if _is_called(photo, image.name)]
        if named[photo.name] > 1 or len(same) > 1:
            whole = _bare(photo.absolute()).as_posix()
            tails = [f"/{_bare(PurePosixPath(image.name))}".replace("//", "/") for image in same]
            same = [image for image, tail in zip(same, tails, strict=True) if whole.endswith(tail)]
        if len(same) == 1:
            matched[photo] = same[0]
    claims = Counter(image.name for image in matched.values())
    known = {photo: image.pose for photo, image in matched.items() if claims[image.name] == 1}
    if not known:
        raise DatasetError(
            f"{source} has none of these photos.",
            f"Its images are called {', '.join(image.name for image in listed[:3])}.",
        )
    return known


def _is_called(photo: Path, name: str) -> bool:
    """Tells whether a model's name of a photo's stem has its ending, or none."""
    ending = PurePosixPath(name).suffix.lower()
    return ending == photo.suffix.lower() or ending not in PHOTO_SUFFIXES


def _bare(path: PurePath) -> PurePath:
    return path.with_suffix("") if path.suffix.lower() in PHOTO_SUFFIXES else path


def tied_notes(model: Path | None, photos: Sequence[Path], known: Mapping[Path, Pose]) -> list[str]:
    """Returns a line that says how many of a flight's photos a model has, where it lacks some; else none."""
    tied = sum(photo in known for photo in photos)
    if model is None or tied == len(photos):
        return []
    few = ": too few to tie the photos together" if tied < FEWEST_PHOTOS else ""
    return [f"{tied} of these photos are in {model}, under their names{few}"]


def with_small_mask(photo: PreparedPhoto) -> PreparedPhoto:
    """Returns a photo whose mask is no larger than methods need: hundreds are held at a time."""
    if photo.mask is None:
        return photo
    return replace(photo, mask=no_wider(photo.mask, _MASK_WIDTH, photo.pinhole))


def picture_file(photo: PreparedPhoto, copy: Path) -> Path | None:
    """Returns a file of a photo as its pinhole sees it: the photo, or a smaller one, written to ``copy``.

    None where it cannot be decoded: methods for flights can do without.
    """
    if not photo.camera.distortion:
        return photo.request.photo
    pixels = read_picture(photo.request.photo)
    if pixels is None:
        return None
    width = min(_PICTURE_WIDTH, pixels.shape[1])
    height = max(1, round(width * photo.camera.height / photo.camera.width))
    small = undistorted(_scaled(pixels, width, height), photo.camera, photo.pinhole)
    write_bytes(copy, encoded(small, copy.suffix))
    return copy


def _scaled(pixels: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    import cv2

    resized_pixels = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized_pixels, dtype=np.uint8)


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
    listed, notes = brought(read_pose_file(path, "auto", names)[1], crs)
    return RoughPoses(path, poses_by_photo(path, listed, photos), notes)


def saved_masks_note(photos: Sequence[Path]) -> str | None:
    """Returns that masks saved beside photos are not used; None where there are none."""
    saved = [mask for photo in photos if (mask := photo.with_name(mask_name(photo.stem))).is_file()]
    if not saved:
        return None
    if len(photos) == 1:
        return f"The mask beside the photo is not used; use it with --mask {shlex.quote(str(saved[0]))}."
    folders = {mask.parent for mask in saved}
    folder = shlex.quote(str(saved[0].parent)) if len(folders) == 1 else "DIR"
    return f"Masks beside {len(saved)} of the photos are not used; use them with --masks {folder}."


def heading_note(photos: Sequence[Path], heading_deg: float | None) -> str | None:
    """Returns that a heading given takes the place of those which several photos state; None otherwise."""
    if heading_deg is None or len(photos) < 2:
        return None
    stated = 0
    for photo in photos:
        try:
            stated += read_photo_metadata(photo).gimbal_yaw_deg is not None
        except DatasetError:  # the answer for that photo says so
            continue
    if not stated:
        return None
    return f"--heading {heading_deg:g} overrides the heading in the metadata of {count_of(stated, 'photos')}."


@dataclass(frozen=True, slots=True, eq=False)
class RoughStart:
    """Where a reconstruction is, roughly."""

    similarity: Similarity  # from the model to the city's coordinates
    source: str  # where it came from, in words
    notes: tuple[str, ...] = ()  # what the reader should know of it


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
    """Returns the similarity to start from; ``frame`` is None where nobody knows the city's place on Earth.

    Raises:
        LodbenchError: Too few images have a rough pose, or a file cannot be read.
    """
    if request.start is not None and request.start.suffix == ".json":
        values = read_json(request.start)
        if "similarity" in values:
            similarity = _stated_similarity(values["similarity"], request.start)
            return RoughStart(similarity, f"the similarity in {request.start}")
    if request.start is not None:
        listed, notes = brought(
            read_pose_file(request.start, "auto")[1], None if frame is None else frame.crs
        )
        known, source = _by_name(images, listed), str(request.start)
        _require_enough_rough(len(known), len(images), source, [])
    else:
        stated = _stated_by_photos(request, images, frame)
        known, source = stated.poses, "what the photos state"
        _require_enough_rough(len(known), len(images), source, stated.faults)
        notes = place_notes(frame, stated.photos, request.heights)
    mine = {image.name: image.pose for image in images}
    sigmas = np.broadcast_to(ROUGH_M, (len(known), 3)), np.full(len(known), ROUGH_DEG)
    fitted = fit_similarity([mine[name] for name in known], list(known.values()), *sigmas)
    away = float(np.median(fitted.distances_m))
    words = f"{source}: {len(known)} cameras, {away:.1f} m apart in the median"
    return RoughStart(fitted.similarity, words, notes)


def _require_enough_rough(usable: int, count: int, source: str, faults: Sequence[LodbenchError]) -> None:
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
