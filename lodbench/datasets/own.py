"""Anybody's photos, poses and masks as a dataset folder whose cameras are pinholes.

Images are those of a drone's photos, or of another program's model.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from lodbench.datasets.faults import is_decodable, mask_fault
from lodbench.datasets.folder import (
    ABOUT_FILE,
    LENS_FILE,
    MEASUREMENTS_FILE,
    SEQUENCE_FILE,
    sealed_about,
    write_poses,
)
from lodbench.datasets.pose_text import FoundPose, lines_to_text
from lodbench.errors import ConfigError, DatasetError, LodbenchError
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.photos.camera import camera_from_photo, camera_given, pinhole_of, undistorted
from lodbench.photos.files import (
    PHOTO_SUFFIXES,
    copies_among,
    find_photos,
    in_pose_lines,
    mask_names,
    require_photos,
    split_flights,
)
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import Measurements, measured_of
from lodbench.photos.metadata import PhotoMetadata, read_photo_metadata
from lodbench.photos.pictures import encoded, read_picture
from lodbench.photos.pose import HeightOptions, pose_from_photo, require_stated
from lodbench.storage import make_folder, new_folder, write_bytes, write_text

_JPEG_QUALITY = 95


@dataclass(frozen=True, slots=True, eq=False)
class OwnImage:
    """One image to put into a dataset."""

    name: str  # as its source calls it; folders and spaces do not survive in a dataset
    camera: Camera  # of the photo as stored, lens distortion included
    prior: Pose | None = None  # rough pose in the city's coordinates, or None
    truth: Pose | None = None  # true pose, or None
    photo: Path | None = None  # its file, or None
    mask: Path | None = None  # building mask of the photo as stored, or None
    # What its photo says of itself, where the prior is from that; else None
    stated: PhotoMetadata | None = None
    no_prior: str = ""  # why its photo, where it is read for one, gives no prior; "" else
    # As of ``PhotoCamera``, where the camera is by what the photo says of itself
    lens_percent: float | None = None
    camera_sigmas: CameraSigmas | None = None  # how well the camera is known, None where nobody says
    measured: Measurements | None = None  # what its photo states beside, of the prior and the scene
    keeps_folders: bool = False  # whether its name in a dataset has its folders, which tell it from others

    @property
    def file_name(self) -> str:
        """Returns its name in a dataset: without folders, or these as words; and spaces, which poses lack."""
        name = self.name.replace("/", "_") if self.keeps_folders else PurePosixPath(self.name).name
        return in_pose_lines(name)


@dataclass(frozen=True, slots=True)
class Written:
    """What was written, and what was not."""

    folder: Path
    names: tuple[str, ...]
    undistorted: int
    left_out: tuple[tuple[str, str], ...]


def find_mask(folder: Path | None, name: str, photo: Path | None = None) -> Path | None:
    """Returns the mask of an image: of its name, of its stem as PNG, or as ``lodbench mask`` calls it.

    Args:
        folder: Of masks; None has none.
        name: Of the image, with as many folders as are known.
        photo: The image's file, which may lie in that folder and is not its own mask.
    """
    if folder is None:
        return None
    candidates = (find_inside(folder, spelt) for spelt in _mask_names(PurePosixPath(name)))
    own = None if photo is None else photo.resolve()
    return next((file for file in candidates if file is not None and file.resolve() != own), None)


def _mask_names(image: PurePosixPath) -> list[str]:
    return list(dict.fromkeys(str(image.parent / spelt) for spelt in mask_names(image.name)))


def find_photo(folder: Path, name: str) -> Path | None:
    """Returns the photo that a model's name means, which may lack its ending or have it in other letters."""
    path = PurePosixPath(name)
    is_whole = path.suffix.lower() in PHOTO_SUFFIXES
    bare, endings = (path.with_suffix(""), (path.suffix.lower(),)) if is_whole else (path, PHOTO_SUFFIXES)
    names = [f"{bare}{spelt}" for ending in endings for spelt in (ending, ending.upper())]
    matches = [file for file in (find_inside(folder, spelt) for spelt in names) if file is not None]
    return find_inside(folder, name) or (matches[0] if len(matches) == 1 else None)


def require_some_mask(folder: Path, names: Sequence[str], photos: Sequence[Path | None] = ()) -> None:
    """Makes sure that a folder holds the mask of one image at least.

    Args:
        folder: Of masks.
        names: Of the images, as for `find_mask`.
        photos: Their files, where these may lie in the folder.

    Raises:
        DatasetError: It holds none; the hint says what the first is looked for as.
    """
    files = photos or [None] * len(names)
    if not any(find_mask(folder, name, photo) for name, photo in zip(names, files, strict=True)):
        wanted = " or ".join(PurePosixPath(spelt).name for spelt in _mask_names(PurePosixPath(names[0])))
        raise DatasetError(f"{folder} holds no mask of any image.", f"The first is looked for as {wanted}.")


def find_inside(folder: Path, name: str) -> Path | None:
    """Returns the file that a model's name means: with its folders, or else without; never one outside."""
    root = folder.resolve()
    for path in (folder / name, folder / PurePosixPath(name).name):
        try:
            if path.resolve().is_relative_to(root) and path.is_file():
                return path
        except (OSError, ValueError):  # a name too long, or with a NUL
            continue
    return None


def shared_files(files: Iterable[Path | None]) -> set[Path]:
    """Returns the files that several names were found to mean: without their folders some are alike."""
    return {file for file, count in Counter(files).items() if file is not None and count > 1}


def require_new_folder(folder: Path) -> None:
    """Makes sure that nothing is written over.

    Raises:
        ConfigError: The folder exists and is not empty, or is a file.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder} is there already.", "Name a new folder: nothing is written over.")


def write_dataset(
    images: Sequence[OwnImage],
    folder: Path,
    about: Mapping[str, Any],
    advance: Callable[[], None] = lambda: None,
    left_out: Sequence[tuple[str, str]] = (),
    complete: Callable[[Path], object] = lambda folder: None,
) -> Written:
    """Writes a dataset folder: poses, cameras, photos and masks, undistorted where a lens has distortion.

    Args:
        images: What goes in.
        folder: A new or empty folder.
        about: What ``dataset.json`` should keep of where it came from.
        advance: Called after each image.
        left_out: Name and reason of images that were left out before.
        complete: Called with the full folder before it takes its name, to write what else belongs in it.

    Raises:
        LodbenchError: The folder is not empty, two images have one name, or none could be written.
    """
    require_new_folder(folder)
    names = _dataset_names(images)
    make_folder(folder.parent)
    left_out, num_undistorted = list(left_out), 0
    kept: list[tuple[str, OwnImage, Camera]] = []
    with new_folder(folder) as filling:
        for name, image in zip(names, images, strict=True):
            try:
                pinhole = pinhole_of(image.camera)
                num_undistorted += _write_pictures(filling, name, image, pinhole)
                kept.append((name, image, pinhole))
            except LodbenchError as fault:
                left_out.append((image.name, fault.message))
            advance()
        if not kept:
            name, reason = left_out[0] if left_out else ("", "there are no images")
            raise DatasetError(f"No image could be used; the first is {name}: {reason}")
        _write_texts(filling, kept, {**about, "left_out": [list(pair) for pair in left_out]})
        complete(filling)
    return Written(folder, tuple(name for name, _, _ in kept), num_undistorted, tuple(left_out))


def _dataset_names(images: Sequence[OwnImage]) -> list[str]:
    """Returns a name without folders and spaces for each image; no two images, or masks, have the same."""
    names = [image.file_name for image in images]
    stems = [Path(name).stem for name, image in zip(names, images, strict=True) if image.mask is not None]
    for what, listed in (("images", names), ("images with a mask", stems)):
        name, count = Counter(listed).most_common(1)[0] if listed else ("", 0)
        if count > 1:
            raise DatasetError(
                f"{count} {what} are called {name}.", "Make a dataset of each folder, or rename the images."
            )
    return names


def _write_pictures(folder: Path, name: str, image: OwnImage, pinhole: Camera) -> int:
    """Writes an image's photo and mask, if they fit its camera; returns 1 if they were undistorted."""
    is_straight = not image.camera.distortion
    contents, size = dict[Path, bytes](), (image.camera.width, image.camera.height)
    if image.photo is not None:
        header = read_photo_metadata(image.photo)
        if (header.width, header.height) != size:
            stored = f"the photo is {header.width} x {header.height}"
            raise DatasetError(f"{stored}, its camera {size[0]} x {size[1]}")
        if not is_decodable(image.photo):
            raise DatasetError(f"{image.photo} is damaged or cut off")
        target = folder / "Query_image" / name
        contents[target] = (
            image.photo.read_bytes() if is_straight else _encoded(image.photo, image.camera, pinhole, target)
        )
    if image.mask is not None:
        if fault := mask_fault(image.mask, size):
            raise DatasetError(fault)
        target = folder / "masks" / f"{Path(name).stem}.png"
        contents[target] = _encoded(image.mask, image.camera, pinhole, target)
    for target, content in contents.items():
        make_folder(target.parent)
        write_bytes(target, content)
    return int(bool(contents) and not is_straight)


def _encoded(source: Path, camera: Camera, pinhole: Camera, target: Path) -> bytes:
    import cv2

    is_mask = target.parent.name == "masks"
    picture = read_picture(source, as_stored=is_mask)
    if picture is None:
        raise DatasetError(f"{source} cannot be decoded")
    options = [] if is_mask else [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    return encoded(undistorted(picture, camera, pinhole), target.suffix, options)


def _flights(images: Sequence[tuple[str, OwnImage]]) -> list[str]:
    """Returns a line for each image, its name and its flight; none where one says nothing of itself."""
    known = [(i.photo, i.stated) for _, i in images if i.photo is not None and i.stated is not None]
    if len(known) < len(images):
        return []
    flights = enumerate(split_flights(known), start=1)
    flight_of = {row: number for number, flight in flights for row in flight.rows}
    return [f"{name} flight_{flight_of[row]}" for row, (name, _) in enumerate(images)]


def _write_texts(folder: Path, kept: Sequence[tuple[str, OwnImage, Camera]], about: dict[str, Any]) -> None:
    truth = {name: image.truth for name, image, _ in kept if image.truth is not None}
    priors = {name: image.prior for name, image, _ in kept if image.prior is not None}
    sigmas = {name: image.camera_sigmas for name, image, _ in kept}
    write_poses(folder, {name: pinhole for name, _, pinhole in kept}, truth, priors, sigmas=sigmas)
    listed = {
        SEQUENCE_FILE: _flights([(name, image) for name, image, _ in kept]),
        LENS_FILE: [f"{name} {i.lens_percent:.2f}" for name, i, _ in kept if i.lens_percent is not None],
        MEASUREMENTS_FILE: [" ".join([n, *i.measured.words()]) for n, i, _ in kept if i.measured is not None],
    }
    for name, lines in listed.items():
        if lines:
            write_text(folder / name, lines_to_text(lines))
    stated = sealed_about({"truth": bool(truth), "priors": bool(priors), **about})
    write_text(folder / ABOUT_FILE, json.dumps(stated, indent=2, ensure_ascii=False) + "\n")


LeftOut = list[tuple[str, str]]


def images_from_photos(
    folder: Path,
    frame: MapFrame,
    heights: HeightOptions,
    *,
    masks: Path | None = None,
    camera: Camera | None = None,
    camera_sigmas: CameraSigmas | None = None,
) -> tuple[list[OwnImage], LeftOut]:
    """Returns the photos of a folder with the rough poses their metadata states, and those without one.

    Args:
        folder: Photos, in it or below it.
        frame: The city's coordinates.
        heights: How the drone's heights become the city's.
        masks: Folder of masks of the photos as stored, or None.
        camera: Intrinsics of all photos, before their own.
        camera_sigmas: How well these are known, None for exactly.

    Raises:
        LodbenchError: There are no photos, or no height of any could be converted.
    """
    images, left_out, last = list[OwnImage](), LeftOut(), LodbenchError("")
    photos = find_photos(folder, masks)
    require_photos(photos, folder)
    mask_files = [find_mask(masks, path.name, path) for path in photos]
    copies, _ = copies_among(photos, mask_files)
    for row, (path, mask) in enumerate(zip(photos, mask_files, strict=True)):
        if row in copies:
            left_out.append((path.name, copies[row]))
            continue
        try:
            photo = read_photo_metadata(path)
            require_stated(photo, heights, knows_camera=camera is not None)
            own_camera = camera_given(camera, camera_sigmas) if camera else camera_from_photo(photo)
            prior = pose_from_photo(photo, frame, heights)
            own = OwnImage(path.name, own_camera.camera, prior, photo=path, mask=mask, stated=photo)
            own = replace(own, lens_percent=own_camera.lens_percent, camera_sigmas=own_camera.camera_sigmas)
            images.append(replace(own, measured=measured_of(photo, heights)))
        except LodbenchError as fault:
            # Should none be left, the last one's hint says what to do about all.
            left_out.append((path.name, fault.message))
            last = fault
    if not images:
        elsewhere = "Poses from elsewhere: --colmap; one by one, localize takes"
        hint = last.hint.marked.replace("lodbench localize takes", elsewhere)
        raise DatasetError(f"No photo of {folder} can be used; {last.message.marked}", hint)
    return images, left_out


def images_from_poses(
    posed_images: Sequence[FoundPose],
    *,
    photos: Path | None = None,
    masks: Path | None = None,
    cameras: Mapping[str, tuple[Camera, CameraSigmas | None]] | None = None,
    camera_sigmas: CameraSigmas | None = None,
    frame: MapFrame | None = None,
    heights: HeightOptions | None = None,
) -> tuple[list[OwnImage], LeftOut]:
    """Returns posed images, their poses as the truth, with priors from the photos where these state one.

    Args:
        posed_images: Images of another program's model, in the city's coordinates.
        photos: Folder that the image names are relative to, or None for poses alone.
        masks: Folder of masks of the photos as stored, or None.
        cameras: Intrinsics by image name and how well they are known, where the model has none.
        camera_sigmas: How well the model's are known, None where nobody says.
        frame: The city's coordinates, to read the photos' own positions; None for no priors.
        heights: How the drone's heights become the city's.
    """
    images, left_out = list[OwnImage](), LeftOut()
    for image in posed_images:
        photo = None if photos is None else find_photo(photos, image.name)
        if photo is not None:  # matrices and Metashape's labels lack the ending
            image = image._replace(name=str(PurePosixPath(image.name).with_name(photo.name)))
        camera, sigmas = image.camera, camera_sigmas
        if camera is None and cameras is not None:
            camera, sigmas = cameras.get(Path(image.name).name, (None, None))
        if camera is None:
            reason = image.no_camera or "no camera: the format has none, or not for this image"
            left_out.append((image.name, reason))
        elif photos is not None and photo is None:
            left_out.append((image.name, f"no such photo in {photos}"))
        else:
            mask = find_mask(masks, image.name, photo)
            own = OwnImage(image.name, camera, None, image.pose, photo, mask, camera_sigmas=sigmas)
            images.append(own if frame is None else _with_stated_prior(own, frame, heights))
    return named_apart(images), left_out


def named_apart(images: Sequence[OwnImage]) -> list[OwnImage]:
    """Returns images that have their folders in their names where these tell them apart: ``cam1_x.jpg``."""
    stems = Counter(Path(image.file_name).stem for image in images)
    return [replace(image, keeps_folders=stems[Path(image.file_name).stem] > 1) for image in images]


def _with_stated_prior(image: OwnImage, frame: MapFrame, heights: HeightOptions | None) -> OwnImage:
    """Returns an image with the rough pose that its photo states, or with the reason why it states none."""
    if image.photo is None:
        return image
    try:
        stated = read_photo_metadata(image.photo)
        measured = measured_of(stated, heights or HeightOptions())
        return replace(image, prior=pose_from_photo(stated, frame, heights), stated=stated, measured=measured)
    except DatasetError as fault:
        return replace(image, no_prior=fault.message.rstrip("."))
