"""A photo made ready for a method: its camera, its pinhole, its mask, and where it was, roughly."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Entry
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.harness.city import require_near_city, require_same_region
from lodbench.harness.photo import PhotoRequest
from lodbench.harness.photo.outputs import PhotoView
from lodbench.harness.tracebacks import told_as_fault
from lodbench.photos.camera import (
    PhotoCamera,
    camera_from_photo,
    camera_given,
    pinhole_of,
    require_photo_size,
    undistorted,
)
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import Measurements
from lodbench.photos.metadata import PhotoMetadata, read_photo_metadata
from lodbench.photos.pictures import read_picture
from lodbench.photos.pose import (
    START_OF_EACH,
    PoseNotStated,
    latitude_longitude_of,
    pose_at,
    pose_from_photo,
    require_stated,
)
from lodbench.segmentation import MapGuidedSegmenter, check_mask
from lodbench.segmentation.masks import read_mask


@dataclass(frozen=True, slots=True, eq=False)
class PreparedPhoto:
    """What is known of a photo before the city is.

    Attributes:
        request: The request.
        stated: What its metadata say.
        camera: Of the photo as stored, lens included.
        camera_source: Where the camera's numbers came from.
        lens_percent: As of ``PhotoCamera``.
        camera_sigmas: Likewise.
        measured: What was measured beside it.
        pinhole: The camera that is localised.
        mask: (H, W) probability of building as the pinhole sees it; None where no mask is looked at.
    """

    request: PhotoRequest
    stated: PhotoMetadata
    camera: Camera
    camera_source: str
    lens_percent: float | None
    camera_sigmas: CameraSigmas
    measured: Measurements | None
    pinhole: Camera
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
            place = latitude_longitude_of(self.stated, self.request.given)
            require_same_region(what, *place, scene)
        prior = _prior(self.request, self.stated, frame)
        require_near_city(what, [prior], scene)
        return prior


def prepare_photo(request: PhotoRequest, requires: Collection[str]) -> PreparedPhoto:
    """Returns what a method needs of a photo.

    Raises:
        LodbenchError: The photo, its metadata, mask or camera is missing or not fit.
    """
    stated = read_photo_metadata(request.photo)
    rough = None if request.start is None else request.start.of(request.photo)
    require_stated(
        stated,
        request.heights,
        request.given,
        knows_place=rough is not None or request.center is not None,
        knows_look=rough is not None,
        knows_camera=request.camera is not None,
    )
    found = _camera(request, stated)
    pinhole = pinhole_of(found.camera)
    mask = pinhole_mask(request, found.camera, pinhole) if Input.MASK in requires else None
    known = found.source, found.lens_percent, found.camera_sigmas, request.measured_of(stated)
    return PreparedPhoto(request, stated, found.camera, *known, pinhole, mask)


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


def _camera(request: PhotoRequest, photo: PhotoMetadata) -> PhotoCamera:
    if request.camera is None:
        return camera_from_photo(photo)
    require_photo_size(request.camera, photo.name, photo.width, photo.height)
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
        with told_as_fault(part, request.out, request.photo.name):
            probability = request.segmenter.segment(entry)
    else:
        raise DatasetError("There is no mask of the buildings.", "Give `--mask FILE`: white is building.")
    return np.asarray(undistorted(check_mask(probability, camera), camera, pinhole))


def _prior(request: PhotoRequest, photo: PhotoMetadata, frame: MapFrame | None) -> Pose:
    if request.start is not None:
        return request.start.of(request.photo)
    if request.center is not None:
        east, north, _ = request.center
        convergence = 0.0 if frame is None else frame.convergence_deg(east, north)
        return pose_at(request.center, convergence, photo, request.given)
    if frame is None:
        raise PoseNotStated(
            f"{request.city.name} names no reference system, so GPS means nothing in it.",
            "Name it with `--crs`, or give `--center EAST NORTH UP` in the city's coordinates.",
            f"Name it with `--crs`, or give {START_OF_EACH}.",
        )
    return pose_from_photo(photo, frame, request.heights, request.given)
