"""Where the images of one's own dataset come from: a drone's photos, or another program's model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from lodbench.datasets.exchange.posed import FoundPose
from lodbench.datasets.own import OwnImage, find_mask, find_photo
from lodbench.errors import DatasetError, LodbenchError
from lodbench.geometry import Camera, CameraSigmas
from lodbench.photos.camera import camera_from_photo, camera_given
from lodbench.photos.files import copies_among, find_photos, require_photos
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import measured_of
from lodbench.photos.metadata import read_photo_metadata
from lodbench.photos.pose import HeightOptions, pose_from_photo, require_stated

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
    images: list[OwnImage] = []
    left_out: LeftOut = []
    last = LodbenchError("")
    photos = find_photos(folder, masks)
    require_photos(photos, folder)
    found_masks = [find_mask(masks, path.name, path) for path in photos]
    copies, _ = copies_among(photos, found_masks)
    for row, (path, mask) in enumerate(zip(photos, found_masks, strict=True)):
        name = path.name
        if row in copies:
            left_out.append((name, copies[row]))
            continue
        try:
            photo = read_photo_metadata(path)
            require_stated(photo, heights, knows_camera=camera is not None)
            found = camera_given(camera, camera_sigmas) if camera else camera_from_photo(photo)
            prior = pose_from_photo(photo, frame, heights)
            own = OwnImage(name, found.camera, prior, photo=path, mask=mask, stated=photo)
            sigmas = found.camera_sigmas
            images.append(
                replace(
                    own,
                    lens_percent=found.lens_percent,
                    camera_sigmas=sigmas,
                    measured=measured_of(photo, heights),
                )
            )
        except LodbenchError as fault:
            # Should none be left, the last one's hint says what to do about all.
            left_out.append((name, fault.message))
            last = fault
    if not images:
        hint = last.hint.marked.replace(
            "lodbench localize takes", "Poses from elsewhere: --colmap; one by one, localize takes"
        )
        raise DatasetError(f"No photo of {folder} can be used; {last.message.marked}", hint)
    return images, left_out


def images_from_poses(
    found: Sequence[FoundPose],
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
        found: Images of another program's model, in the city's coordinates.
        photos: Folder that the image names are relative to, or None for poses alone.
        masks: Folder of masks of the photos as stored, or None.
        cameras: Intrinsics by image name and how well they are known, where the model has none.
        camera_sigmas: How well the model's are known, None where nobody says.
        frame: The city's coordinates, to read the photos' own positions; None for no priors.
        heights: How the drone's heights become the city's.
    """
    images: list[OwnImage] = []
    left_out: LeftOut = []
    for image in found:
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
            own = OwnImage(image.name, camera, None, image.pose, photo, find_mask(masks, image.name, photo))
            own = replace(own, camera_sigmas=sigmas)
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
