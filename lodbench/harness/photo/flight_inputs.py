"""What photos are solved with: masks, pictures, rough poses and those of a reconstruction; what is unused."""

from __future__ import annotations

import shlex
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.exchange.colmap import read_colmap
from lodbench.datasets.own import find_mask
from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.datasets.pose_text import FoundPose
from lodbench.errors import DatasetError
from lodbench.geometry import Pose
from lodbench.harness.photo import RoughPoses
from lodbench.harness.photo.prepare import PreparedPhoto
from lodbench.methods.flight.relative_poses import FEWEST_PHOTOS
from lodbench.photos.camera import undistorted
from lodbench.photos.files import PHOTO_SUFFIXES, copies_among, mask_name
from lodbench.photos.metadata import read_photo_metadata
from lodbench.photos.pictures import encoded, read_picture
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
    found = [find_mask(masks, f"{photo.parent.name}/{photo.name}", photo) for photo in photos]
    copies, unreadable = copies_among(photos, found)
    reasons = copies | unreadable
    users: dict[Path | None, list[int]] = defaultdict(list)
    for row, mask in enumerate(found):
        if row not in copies:
            users[mask].append(row)
    for row, (photo, mask) in enumerate(zip(photos, found, strict=True)):
        if row in reasons:
            continue
        if masks is not None and mask is None:
            reasons[row] = f"{masks} holds no mask of it"
        elif mask is not None and len(users[mask]) > 1:
            others = ", ".join(str(photos[other]) for other in users[mask] if other != row)
            own = Path(photo.parent.name) / f"{photo.stem}.png"
            reasons[row] = f"the mask {mask} may be of {others} as well: name it {own}"
    return found, reasons


def poses_in_model(model: Path | None, photos: Sequence[Path]) -> dict[Path, Pose]:
    """Returns the poses of photos in a COLMAP model, by file; none without a model.

    A model's names may lack their endings, or have them in other letters. Where several photos or images have
    one name, folders tell them apart; what they do not is left out.

    Raises:
        DatasetError: The model cannot be read, or has none of the photos.
    """
    return {} if model is None else poses_by_photo(model, list(read_colmap(model)), photos)


def poses_by_photo(source: Path, found: Sequence[FoundPose], photos: Sequence[Path]) -> dict[Path, Pose]:
    """Returns the poses of photos among those of a file or model, by photo; names as of ``poses_in_model``.

    Raises:
        DatasetError: There is none of any of the photos.
    """
    images: dict[str, list[FoundPose]] = defaultdict(list)
    for image in found:
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
            f"Its images are called {', '.join(image.name for image in found[:3])}.",
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
    found, notes = brought(read_pose_file(path, "auto", names)[1], crs)
    return RoughPoses(path, poses_by_photo(path, found, photos), notes)


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
