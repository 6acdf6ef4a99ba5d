"""A photo to be localised, made ready for a method: its camera, its pinhole, its mask, and its rough pose."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Entry
from lodbench.errors import DatasetError, require_within
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.harness.city import require_near_city, require_same_region
from lodbench.harness.photo.outputs import PhotoView
from lodbench.harness.tracebacks import reported_as_fault
from lodbench.methods import Method
from lodbench.photos import pose
from lodbench.photos.camera import (
    PhotoCamera,
    camera_from_photo,
    camera_given,
    pinhole_of,
    require_photo_size,
    undistorted,
)
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import Measurements, measured_of
from lodbench.photos.metadata import PhotoMetadata, read_photo_metadata
from lodbench.photos.pictures import read_picture
from lodbench.segmentation import MapGuidedSegmenter, Segmenter, check_mask
from lodbench.segmentation.masks import read_mask


@dataclass(frozen=True, slots=True, kw_only=True)
class CityRequest:
    """A city model, how it is read, and how photos are laid on it."""

    city: Path  # city model
    out: Path  # folder to write
    segmenter: Segmenter | None = None  # makes masks where there are none
    heights: pose.HeightOptions = field(
        default_factory=pose.HeightOptions
    )  # how the drone's heights become the city's
    lod: str | None = None  # level of detail, or None for the lowest
    options: ReadOptions = field(default_factory=ReadOptions)  # how to read the city
    roof_height: str | None = None  # rule by which an absent level 1 is derived, or None


@dataclass(frozen=True, slots=True, kw_only=True)
class RoughRequest(CityRequest):
    """Besides, what is known of a photo before what it states.

    Raises:
        ConfigError: A coordinate of ``center`` is not finite.
    """

    camera: Camera | None = None  # intrinsics of the photo as stored, lens distortion included
    camera_sigmas: CameraSigmas | None = None  # how well these are known, None for exactly
    given: pose.RoughPlace = field(default_factory=pose.RoughPlace)  # rough place and angles
    # Rough place in the city's coordinates (east, north, up, metres); goes before all others.
    center: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        require_within("--center", self.center, -math.inf)


@dataclass(frozen=True, slots=True, eq=False)
class RoughPoses:
    """What a file says of photos."""

    source: Path  # the file
    poses: Mapping[Path, Pose]  # by the photo's file, in the city's coordinates
    notes: tuple[str, ...] = ()  # what the reader should know of them

    def of(self, photo: Path) -> Pose:
        """Returns the rough pose of a photo.

        Raises:
            DatasetError: The file has none.
        """
        if photo not in self.poses:
            raise DatasetError(
                f"{self.source} has no pose of {photo.name}.", "`--start` needs one of each photo."
            )
        return self.poses[photo]


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoRequest(RoughRequest):
    """What to localise, and how."""

    photo: Path  # the photo
    # Building mask of the photo as it is stored, white = building; goes before the segmenter.
    mask: Path | None = None
    method: Method | None = None  # how to localise; LoD-Loc v2 by default
    seed: int = 0  # seed of the search
    # Rough poses of photos, which go before all else that is known of these; None without any.
    start: RoughPoses | None = None
    # Whether a person said how far off rough poses may be: photos are not asked then.
    has_prior_range: bool = False
    workers: int = 1  # processes that several photos are shared out to; 1 for this one

    def measured_of(self, stated: PhotoMetadata) -> Measurements | None:
        """Returns what was measured beside a photo, deviations of those numbers that are its own among it."""
        if self.start is not None or self.has_prior_range:
            return measured_of(stated, self.heights, range(6))
        given = self.given
        place = given.latitude_deg if self.center is None else self.center
        height = given.height_m if self.center is None else self.center
        others = (place, place, height, given.pitch_deg, given.roll_deg, given.heading_deg)
        return measured_of(stated, self.heights, [k for k, v in enumerate(others) if v is not None])

    @property
    def threads(self) -> int | None:
        """Returns the renderer's threads: one beside other workers, else one per core."""
        return None if self.workers == 1 else 1

    @property
    def has_height(self) -> bool:
        """Returns whether the rough pose's height is in the city's heights, and not what a drone states."""
        return self.start is not None or self.center is not None or self.given.height_m is not None


@dataclass(frozen=True, slots=True, eq=False)
class PreparedPhoto:
    """What is known of a photo before the city is."""

    request: PhotoRequest  # the request
    stated: PhotoMetadata  # what its metadata say
    camera: Camera  # of the photo as stored, lens included
    camera_source: str  # where the camera's numbers came from
    lens_percent: float | None  # as of ``PhotoCamera``
    camera_sigmas: CameraSigmas  # likewise
    measured: Measurements | None  # what was measured beside it
    pinhole: Camera  # the camera that is localised
    # (H, W) probability of building as the pinhole sees it; None where no mask is looked at.
    mask: NDArray[np.float32] | None

    def view(self) -> PhotoView:
        """Returns the photo with its pixels."""
        path = self.request.photo
        return PhotoView(path.name, read_picture(path), self.camera, self.pinhole, self.mask)

    def prior(self, scene: Scene, frame: MapFrame | None) -> Pose:
        """Returns the rough pose, in the city's coordinates.

        Raises:
            DatasetError: Nobody states it, or it is far outside the city, or below.
        """
        what = f"By its position {self.stated.name} was taken"
        if frame is not None and self.request.center is None and self.request.start is None:
            place = pose.latitude_longitude_of(self.stated, self.request.given)
            require_same_region(what, *place, scene)
        if self.request.start is None:
            prior = rough_pose(self.request, self.stated, frame)
        else:
            prior = self.request.start.of(self.request.photo)
        require_near_city(what, [prior], scene)
        return prior


def prepare_photo(request: PhotoRequest, requires: Collection[str]) -> PreparedPhoto:
    """Returns what a method needs of a photo.

    Raises:
        LodbenchError: The photo, its metadata, mask or camera is missing or not fit.
    """
    stated = read_photo_metadata(request.photo)
    rough = None if request.start is None else request.start.of(request.photo)
    pose.require_stated(
        stated,
        request.heights,
        request.given,
        knows_place=rough is not None or request.center is not None,
        knows_look=rough is not None,
        knows_camera=request.camera is not None,
    )
    camera = rough_camera(request, stated)
    pinhole = pinhole_of(camera.camera)
    mask = pinhole_mask(request, camera.camera, pinhole) if Input.MASK in requires else None
    known = camera.source, camera.lens_percent, camera.camera_sigmas, request.measured_of(stated)
    return PreparedPhoto(request, stated, camera.camera, *known, pinhole, mask)


def undistorted_photo(view: PhotoView, folder: Path) -> Path:
    """Returns a file of the photo as the pinhole sees it.

    Raises:
        DatasetError: Its pixels cannot be decoded.
    """
    import cv2

    pixels = view.undistorted()
    if pixels is None:
        raise DatasetError(
            f"The pixels of {view.name} cannot be decoded.", "It may be damaged or cut off: copy it again."
        )
    # Without compression, which would take longer than all that is made of it.
    path = folder / f"{Path(view.name).stem}.bmp"
    path.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes())
    return path


def rough_camera(request: RoughRequest, photo: PhotoMetadata, is_video: bool = False) -> PhotoCamera:
    """Returns the camera that is given, or else what the photo states.

    Raises:
        DatasetError: It is of another size than the photo, or the photo states none.
    """
    if request.camera is None:
        return camera_from_photo(photo)
    require_photo_size(request.camera, photo.name, photo.width, photo.height, is_video=is_video)
    return camera_given(request.camera, request.camera_sigmas)


def pinhole_mask(
    request: PhotoRequest, camera: Camera, pinhole: Camera, name: str = ""
) -> NDArray[np.float32]:
    """Returns the (H, W) float32 probability of building at each pixel, in [0, 1], as the pinhole sees it.

    Args:
        request: Has the mask, or who makes it.
        camera: Of the photo as stored, lens included.
        pinhole: The camera that is localised.
        name: Of the photo, where it is not its file's.

    Raises:
        DatasetError: There is neither, or the segmenter looks at the map.
        QueryFault: The mask is of another aspect than the photo, or it or the photo cannot be read, or the
            segmenter's own code raised.
    """
    if request.mask is not None:
        probability = read_mask(request.mask)
    elif isinstance(request.segmenter, MapGuidedSegmenter):
        raise DatasetError(
            f"segmenter {request.segmenter.name} looks at the map, which needs a dataset.",
            "Make one with lodbench dataset init, and use lodbench run.",
        )
    elif request.segmenter is not None:
        entry = Entry(name or request.photo.name, "", camera, None, request.photo, None)
        part = f"segmenter {request.segmenter.name}"
        with reported_as_fault(part, request.out, request.photo.name):
            probability = request.segmenter.segment(entry)
    else:
        raise DatasetError("There is no mask of the buildings.", "Give `--mask FILE`: white is building.")
    return np.asarray(undistorted(check_mask(probability, camera), camera, pinhole))


def rough_pose(request: RoughRequest, photo: PhotoMetadata, frame: MapFrame | None) -> Pose:
    """Returns where a photo was, by what is given and what it states, in the city's coordinates.

    Raises:
        DatasetError: Nobody says it, or GPS means nothing in the city.
    """
    if request.center is not None:
        east, north, _ = request.center
        convergence = 0.0 if frame is None else frame.convergence_deg(east, north)
        return pose.pose_at(request.center, convergence, photo, request.given)
    if frame is None:
        raise pose.PoseNotStated(
            f"{request.city.name} names no reference system, so GPS means nothing in it.",
            "Name it with `--crs`, or give `--center EAST NORTH UP` in the city's coordinates.",
            f"Name it with `--crs`, or give {pose.START_OF_EACH}.",
        )
    return pose.pose_from_photo(photo, frame, request.heights, request.given)
