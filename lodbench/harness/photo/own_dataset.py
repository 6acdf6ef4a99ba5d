"""One's own photos or another program's poses, and a city, into a dataset folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lodbench import __version__
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.datasets import own
from lodbench.datasets.exchange.kapture_nerfstudio import unposed_images
from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.datasets.pose_text import DEGREES_CRS, FoundPose, read_known_cameras
from lodbench.errors import ConfigError, DatasetError
from lodbench.execution import Progress
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.harness.city import far_words, open_city
from lodbench.photos.files import PHOTO_SUFFIXES
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import place_notes, refused_notes, xmp_note
from lodbench.photos.pictures import picture_size
from lodbench.photos.pose import HeightOptions


@dataclass(frozen=True, slots=True)
class OwnRequest:
    """What goes into a dataset folder."""

    folder: Path  # new folder
    photos: Path | None = None  # folder of photos, or None for poses alone
    poses: Path | None = None  # another program's poses, taken as the truth; None for photos alone
    format: str = "auto"  # of ``poses``: an entry point under ``lodbench.pose_formats``, or ``auto``
    masks: Path | None = None  # folder of building masks of the photos as they are stored, or None
    cameras: Path | None = None  # camera file by image name, for formats without cameras; or None
    camera: Camera | None = None  # intrinsics of all images, or None
    camera_sigmas: CameraSigmas | None = None  # how well these are known, None for exactly
    # Added to the positions of ``poses`` (east, north, up), before they are brought from the reference
    # system that their file declares to the city's.
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    city: Path | None = None  # city model, or None to trust that the poses are in its coordinates
    lod: str | None = None  # level of detail, or None
    options: ReadOptions = field(default_factory=ReadOptions)  # how to read the city
    heights: HeightOptions = field(default_factory=HeightOptions)  # how the drone's heights become the city's
    apart_m: float | None = None  # keep only photos whose views, up to this far, do not meet; None keeps all


@dataclass(frozen=True, slots=True)
class OwnDataset:
    """What was made."""

    written: own.Written
    has_truth: bool
    num_priors: int
    notes: tuple[str, ...]


def make_own_dataset(request: OwnRequest) -> OwnDataset:
    """Writes a dataset folder and returns what is in it; what is not is named, with the reason.

    Raises:
        LodbenchError: The photos, poses or the city cannot be read, no image can be used, or the folder
            is not new.
    """
    own.require_new_folder(request.folder)
    for path in (request.photos, request.poses, request.masks, request.cameras):
        if path is not None and not path.exists():
            raise DatasetError(f"{path} does not exist.", "Check the path.")
    scene, frame = _open_frame(request)
    images, left_out, kind, reported = _images(request, frame)
    if request.masks is not None:
        own.require_some_mask(
            request.masks, [image.name for image in images], [image.photo for image in images]
        )
    if scene is not None:
        images, far = _near(images, scene)
        left_out += far
    if request.apart_m is not None and scene is not None:
        images, seeing = without_common_view(
            images, float(scene.origin[2] + scene.extent_m[0][2]), request.apart_m
        )
        left_out += seeing
    about = {
        "made_by": f"lodbench {__version__}",
        "from": kind,
        "crs": None if scene is None else scene.crs,
        "city_model": None if request.city is None else _relative(request.city, request.folder),
    }
    with Progress(f"writing {request.folder.name}", len(images)) as progress:
        written = own.write_dataset(images, request.folder, about, progress.advance, left_out)
    kept = [image for image in images if image.file_name in set(written.names)]
    notes = [*reported, *_prior_notes(kept, frame, request.heights)]
    if request.masks is not None:
        notes += _mask_notes(request.masks, kept)
    priors = sum(image.prior is not None for image in kept)
    return OwnDataset(written, request.poses is not None, priors, tuple(notes))


def _prior_notes(images: Sequence[own.OwnImage], frame: MapFrame | None, heights: HeightOptions) -> list[str]:
    """Returns what the reader should know of rough poses from photos: how sure they are, and which lack."""
    stated = [image.stated for image in images if image.stated is not None]
    notes = [*place_notes(frame, stated, heights), *filter(None, [xmp_note(stated)])] if stated else []
    notes += refused_notes(stated)
    lacking = [image for image in images if image.no_prior]
    if lacking:
        first = lacking[0]
        notes.append(
            f"{len(lacking)} of {len(images)} photos state no rough pose; the first, {first.name}: "
            f"{first.no_prior}"
        )
    return notes


def _mask_notes(folder: Path, images: Sequence[own.OwnImage]) -> list[str]:
    """Returns what the reader should know of the masks: those that lack, are of nothing, or are scaled."""
    lacking = [image.name for image in images if image.mask is None]
    used = {image.mask.resolve() for image in images if image.mask is not None}
    files = (path for path in sorted(folder.rglob("*")) if path.suffix.lower() in PHOTO_SUFFIXES)
    strays = [path.name for path in files if path.resolve() not in used and not path.name.startswith("._")]
    scaled = [
        image.name
        for image in images
        if image.mask is not None and picture_size(image.mask) != (image.camera.width, image.camera.height)
    ]
    reported = (
        (lacking, f"of {len(images)} images have no mask"),
        (strays, "masks belong to no image that is used"),
        (scaled, "masks are of another size than their photos, and will be scaled"),
    )
    return [
        f"{len(names)} {words}: {', '.join(names[:3])}{', ...' * (len(names) > 3)}"
        for names, words in reported
        if names
    ]


def _relative(city: Path, folder: Path) -> str:
    """Returns where a city model lies, as seen from a dataset's folder: both may move together."""
    return Path(os.path.relpath(city.expanduser().resolve(), folder.expanduser().resolve())).as_posix()


def _open_frame(request: OwnRequest) -> tuple[Scene | None, MapFrame | None]:
    """Returns the city and its coordinates, each None where it is not there or not known."""
    if request.city is None:
        return None, None
    scene = open_city(request.city, request.lod, request.options, None).scene
    if scene.crs is not None:
        return scene, MapFrame(scene.crs)
    if request.poses is None:
        raise DatasetError(
            f"{request.city.name} names no reference system, so GPS means nothing in it.",
            "Name it with `--crs`.",
        )
    return scene, None


def _images(
    request: OwnRequest, frame: MapFrame | None
) -> tuple[list[own.OwnImage], own.LeftOut, str, tuple[str, ...]]:
    """Returns the images, those left out, what they were read from, and what the reader should know of it."""
    if request.poses is not None:
        kind, listed = read_pose_file(request.poses, request.format)
        placed, reported = brought(
            [_as_asked(image, request) for image in listed], None if frame is None else frame.crs
        )
        images, left_out = own.images_from_poses(
            placed,
            photos=request.photos,
            masks=request.masks,
            cameras=None if request.cameras is None else read_known_cameras(request.cameras),
            camera_sigmas=request.camera_sigmas,
            frame=frame,
            heights=request.heights,
        )
        if kind == "kapture":
            left_out += [(name, "no pose in the kapture") for name in unposed_images(request.poses)]
        if not images:
            name, reason = left_out[0]
            hint = "Give `--cameras FILE` or `--camera 'MODEL W H ...'`." if "camera" in reason else ""
            if "no such photo" in reason:
                hint = "`--images` is the folder of the posed photos."
            raise DatasetError(f"No image can be used; the first is {name}: {reason}.", hint)
        return images, left_out, kind, reported
    if request.photos is None or frame is None:
        raise ConfigError(
            "There are no photos and no poses.", "Give `--images DIR`, `--city FILE`, or a model."
        )
    images, left_out = own.images_from_photos(
        request.photos,
        frame,
        request.heights,
        masks=request.masks,
        camera=request.camera,
        camera_sigmas=request.camera_sigmas,
    )
    return images, left_out, "photos", ()


def _as_asked(image: FoundPose, request: OwnRequest) -> FoundPose:
    if image.crs == DEGREES_CRS and any(request.offset_m):
        raise DatasetError(f"{image.where}: no offset belongs to latitude and longitude.", "Leave it out.")
    return image._replace(camera=request.camera or image.camera, pose=image.pose.shifted(request.offset_m))


def without_common_view(
    images: Sequence[own.OwnImage], ground_m: float, reach_m: float
) -> tuple[list[own.OwnImage], own.LeftOut]:
    """Returns images of which no two see the same ground, the first of each such two, and the others.

    Args:
        images: In the order in which they are preferred; one without a pose is left out.
        ground_m: Height of level ground, in the coordinates of the poses.
        reach_m: How far a view goes, in plan.
    """
    kept: list[own.OwnImage] = []
    views: list[Any] = []
    left_out: own.LeftOut = []
    for image in images:
        pose = image.truth or image.prior
        view = None if pose is None else _view_in_plan(image.camera, pose, ground_m, reach_m)
        if view is None:
            left_out.append((image.name, "no pose to tell what it sees by"))
            continue
        met = next((i for i, other in enumerate(views) if view.intersection(other).area > 0), None)
        if met is None:
            kept.append(image)
            views.append(view)
        else:
            left_out.append((image.name, f"its view meets that of {kept[met].name}"))
    return kept, left_out


def _view_in_plan(camera: Camera, pose: Pose, ground_m: float, reach_m: float) -> Any:
    """Returns the ground that a picture shows as a convex polygon in plan, cut off at a distance."""
    from shapely import MultiPoint

    across, down = np.meshgrid(np.linspace(0, camera.width, 5), np.linspace(0, camera.height, 5))
    rays = np.stack(
        [(across - camera.cx) / camera.fx, (down - camera.cy) / camera.fy, np.ones((5, 5))], axis=2
    )
    rays = rays.reshape(-1, 3) @ pose.rotation
    level = np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-12)
    with np.errstate(divide="ignore"):
        to_ground = np.where(rays[:, 2] < 0, (ground_m - pose.center[2]) / rays[:, 2], np.inf)
    scale = np.minimum(np.maximum(to_ground, 0.0), reach_m / level)
    return MultiPoint(pose.center[:2] + scale[:, None] * rays[:, :2]).convex_hull


def _near(images: Sequence[own.OwnImage], scene: Scene) -> tuple[list[own.OwnImage], own.LeftOut]:
    kept, left_out, hint = [], [], ""
    for image in images:
        pose = image.truth or image.prior
        far = None if pose is None else far_words([pose], scene)
        if far is None:
            kept.append(image)
        else:
            left_out.append((image.name, far[0]))
            hint = hint or far[1]
    if not kept:
        name, away = left_out[0]
        hint += " For poses: is --offset what was taken off?" * (images[0].truth is not None)
        raise DatasetError(f"No camera is near the city model; the first, {name}, is {away}.", hint)
    return kept, left_out


def to_json(made: OwnDataset) -> dict[str, Any]:
    """Returns plain values for JSON."""
    return {
        "folder": str(made.written.folder),
        "images": list(made.written.names),
        "undistorted": made.written.undistorted,
        "left_out": [list(pair) for pair in made.written.left_out],
        "truth": made.has_truth,
        "priors": made.num_priors,
        "notes": list(made.notes),
    }
