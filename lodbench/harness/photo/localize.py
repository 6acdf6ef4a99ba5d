"""One photo and a city: from its metadata to a pose, a picture and a map."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.geojson import write_geojson
from lodbench.datasets.inputs import Input, declared_inputs, require_inputs
from lodbench.datasets.map_frame import MapFrame, Place
from lodbench.datasets.photo_camera import camera_from_photo
from lodbench.datasets.photo_metadata import PhotoMetadata, read_photo_metadata
from lodbench.datasets.photo_pose import (
    HeightOptions,
    RoughPlace,
    datum_note,
    pose_at,
    pose_from_photo,
    require_stated,
)
from lodbench.datasets.pictures import read_picture
from lodbench.datasets.query import Entry
from lodbench.datasets.undistort import pinhole_of, undistorted
from lodbench.errors import DatasetError
from lodbench.evaluation import PoseError, pose_error
from lodbench.geometry import Camera, Pose
from lodbench.harness.city import FURTHEST_M, distance_outside_m, open_city
from lodbench.harness.photo.outputs import PhotoView, photo_features, write_photo_overlay
from lodbench.methods import Estimate, Method
from lodbench.methods.localize import localize
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.reporting.answers import TRUSTED_OVERLAP, is_trusted
from lodbench.reporting.overlays import write_picture
from lodbench.segmentation import MapGuidedSegmenter, Segmenter, check_mask, notes_of
from lodbench.segmentation.masks import read_mask
from lodbench.storage import file_digest, make_folder, write_text

# What one photo has; masks come with --mask or from a segmenter.
_GIVEN = frozenset({Input.MASK, Input.IMAGE, Input.TILT, Input.HEIGHT, Input.MAP})
_SIGMA_NAMES = ("x_m", "y_m", "z_m", "pitch_deg", "roll_deg", "yaw_deg")


@dataclass(frozen=True, slots=True)
class PhotoRequest:
    """What to localise, and how; what is None is taken from the photo's metadata.

    Attributes:
        photo: The photo.
        city: City model.
        out: Folder for the overlay and the map.
        mask: Building mask of the photo as it is stored, white = building; goes before the segmenter.
        segmenter: Makes the mask where none is given.
        camera: Intrinsics of the photo as it is stored, lens distortion included.
        given: Rough place and angles that go before the photo's.
        center: Rough place in the city's coordinates (east, north, up, metres); goes before all others.
        heights: How the drone's heights become the city's.
        lod: Level of detail, or None for the lowest.
        options: How to read the city.
        roof_height: Rule by which an absent level 1 is derived, or None.
        method: How to localise; LoD-Loc v2 by default.
        seed: Seed of the search.
    """

    photo: Path
    city: Path
    out: Path
    mask: Path | None = None
    segmenter: Segmenter | None = None
    camera: Camera | None = None
    given: RoughPlace = field(default_factory=RoughPlace)
    center: tuple[float, float, float] | None = None
    heights: HeightOptions = field(default_factory=HeightOptions)
    lod: str | None = None
    options: ReadOptions = field(default_factory=ReadOptions)
    roof_height: str | None = None
    method: Method | None = None
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class LocalizedPhoto:
    """The answer.

    Attributes:
        photo: File name.
        crs: Reference system of ``pose``, or None for a local frame.
        lod: Level of detail localised against.
        pose: In the city's coordinates.
        prior: Likewise.
        moved: How far the estimate lies from the prior.
        score: Of the method: the overlap (IoU) of mask and model for LoD-Loc v2.
        probability: That the pose is within 2 m and 2 degrees, where the method knows it.
        covariance: (6, 6) of the error in x, y, z (metres), pitch, roll and yaw (degrees), where it knows it.
        sigmas: Standard deviations of x, y, z (metres), pitch, roll and yaw (degrees), where it knows them.
        alternatives: Other poses that fit nearly as well, in the city's coordinates, best first.
        is_trusted: Whether the pose is more likely right than wrong, as far as can be told.
        place: Where on Earth, or None without a reference system.
        camera: Pinhole that was localised.
        camera_source: Where its numbers came from.
        overlay: Picture written.
        geojson: Map written, or None without a reference system.
        notes: What the reader should know.
        features: Of the map.
    """

    photo: str
    crs: str | None
    lod: str
    pose: Pose
    prior: Pose
    moved: PoseError
    score: float
    probability: float | None
    covariance: NDArray[np.float64] | None
    sigmas: tuple[float, ...] | None
    alternatives: tuple[Pose, ...]
    is_trusted: bool
    place: Place | None
    camera: Camera
    camera_source: str
    overlay: Path
    geojson: Path | None
    notes: tuple[str, ...]
    features: tuple[dict[str, Any], ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Returns plain values for JSON, units in the names."""
        return {
            "photo": self.photo,
            "place": None if self.place is None else self.place._asdict(),
            "crs": self.crs,
            "lod": self.lod,
            "pose": _pose_values(self.pose),
            "prior": _pose_values(self.prior),
            "moved_m": self.moved.translation_m,
            "turned_deg": self.moved.rotation_deg,
            "score": self.score,
            "probability": self.probability,
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "sigmas": None if self.sigmas is None else dict(zip(_SIGMA_NAMES, self.sigmas, strict=True)),
            "alternatives": [_pose_values(pose) for pose in self.alternatives],
            "trusted": self.is_trusted,
            "camera": {"colmap": [*self.camera.to_colmap()], "source": self.camera_source},
            "overlay": str(self.overlay),
            "geojson": None if self.geojson is None else str(self.geojson),
            "notes": list(self.notes),
        }


def localize_photo(request: PhotoRequest) -> LocalizedPhoto:
    """Returns the pose of a photo, and writes its overlay and map.

    Raises:
        LodbenchError: The photo, its metadata, mask or camera, or the city is missing or not fit; nothing
            is written then.
    """
    photo = read_photo_metadata(request.photo)
    has_camera, has_place = request.camera is not None, request.center is not None
    require_stated(photo, request.heights, request.given, knows_place=has_place, knows_camera=has_camera)
    camera, camera_source = _camera(request, photo)
    pinhole = pinhole_of(camera)
    method = request.method or LodLocV2()
    requires = declared_inputs(method, "requires", {Input.MASK})
    require_inputs(f"--method {method.name}", requires, _GIVEN, "a single photo has none")
    mask = _pinhole_mask(request, camera, pinhole) if Input.MASK in requires else None
    view = PhotoView(request.photo.name, read_picture(request.photo), camera, pinhole, mask)
    city = open_city(request.city, request.lod, request.options, request.roof_height)
    frame = None if city.scene.crs is None else MapFrame(city.scene.crs)
    prior = _prior(request, photo, frame)
    _check_distance(prior, city.scene, request.photo.name)
    with TemporaryDirectory() as folder:
        image = _undistorted_photo(view, Path(folder)) if Input.IMAGE in requires else None
        estimate = localize(city.scene, pinhole, prior, mask, image=image, method=method, seed=request.seed)
    name, features = request.photo.name, []
    if frame is not None:
        features = photo_features(frame, name, pinhole, city.scene, prior, estimate)
    make_folder(request.out)
    digest = file_digest(request.photo)
    label = _label(request.out, request.photo.stem, digest)
    overlay = request.out / f"{label}_overlay.png"
    write_photo_overlay(overlay, view, city.scene, prior, estimate)
    geojson = request.out / f"{label}.geojson" if features else None
    if geojson is not None:
        write_geojson(features, geojson)
    found = LocalizedPhoto(
        photo=name,
        crs=city.scene.crs,
        lod=city.scene.lod,
        pose=estimate.pose,
        prior=prior,
        moved=pose_error(estimate.pose, prior),
        score=float(estimate.score),
        probability=estimate.probability,
        covariance=estimate.covariance,
        sigmas=_sigmas(estimate),
        alternatives=estimate.alternatives,
        is_trusted=is_trusted(estimate.probability, estimate.score, mask is not None),
        place=None if frame is None else frame.place_of(estimate.pose),
        camera=pinhole,
        camera_source=camera_source,
        overlay=overlay,
        geojson=geojson,
        notes=(
            *city.notes(),
            *(_segmenter_notes(request) if mask is not None else ()),
            *_notes(photo, frame, view, estimate),
        ),
        features=tuple(features),
    )
    values = {"sha256": digest, **found.to_json()}
    write_text(request.out / f"{label}.json", json.dumps(values, indent=2, ensure_ascii=False) + "\n")
    return found


def _label(out: Path, stem: str, digest: str) -> str:
    """Returns what a photo's files are called: its stem, numbered where another photo has that name."""
    for number in itertools.count(1):
        label = stem if number == 1 else f"{stem}_{number}"
        try:
            if json.loads((out / f"{label}.json").read_text(encoding="utf-8"))["sha256"] == digest:
                return label
        except FileNotFoundError:
            if not (out / f"{label}_overlay.png").exists():
                return label
        except (OSError, ValueError, KeyError, TypeError):
            continue  # a file of somebody else's
    raise AssertionError("numbers do not end")


def _camera(request: PhotoRequest, photo: PhotoMetadata) -> tuple[Camera, str]:
    if request.camera is None:
        found = camera_from_photo(photo)
        return found.camera, found.source
    camera = request.camera
    if (camera.width, camera.height) != (photo.width, photo.height):
        raise DatasetError(
            f"The camera is of {camera.width} x {camera.height} pixels, {photo.name} has "
            f"{photo.width} x {photo.height}.",
            "Give the intrinsics of the photo as it is stored.",
        )
    return camera, "given"


def _pinhole_mask(request: PhotoRequest, camera: Camera, pinhole: Camera) -> NDArray[np.float32]:
    """Returns the probability of building at each pixel, as the pinhole sees it."""
    if request.mask is not None:
        probability = read_mask(request.mask)
    elif isinstance(request.segmenter, MapGuidedSegmenter):
        raise DatasetError(
            f"segmenter {request.segmenter.name} looks at the map, which needs a dataset.",
            "Make one with lodbench dataset init, and use lodbench run.",
        )
    elif request.segmenter is not None:
        entry = Entry(request.photo.name, "", camera, None, request.photo, None)
        probability = request.segmenter.segment(entry)
    else:
        raise DatasetError("There is no mask of the buildings.", "Give --mask FILE: white is building.")
    return np.asarray(undistorted(check_mask(probability, camera), camera, pinhole))


def _undistorted_photo(view: PhotoView, folder: Path) -> Path:
    """Returns a file of the photo as the pinhole sees it.

    Raises:
        DatasetError: Its pixels cannot be decoded.
    """
    pixels = view.undistorted()
    if pixels is None:
        raise DatasetError(f"The pixels of {view.name} cannot be decoded.", "Take a JPEG, PNG or TIFF.")
    path = folder / f"{Path(view.name).stem}.png"
    write_picture(path, pixels)
    return path


def _prior(request: PhotoRequest, photo: PhotoMetadata, frame: MapFrame | None) -> Pose:
    if request.center is not None:
        east, north, _ = request.center
        convergence = 0.0 if frame is None else frame.convergence_deg(east, north)
        return pose_at(request.center, convergence, photo, request.given)
    if frame is None:
        raise DatasetError(
            f"{request.city.name} names no reference system, so GPS means nothing in it.",
            "Name it with --crs, or give --center EAST NORTH UP in the city's coordinates.",
        )
    return pose_from_photo(photo, frame, request.heights, request.given)


def _check_distance(prior: Pose, scene: Scene, name: str) -> None:
    """Makes sure that the camera is near the city.

    Raises:
        DatasetError: It is kilometres away from it.
    """
    distance = distance_outside_m(prior, scene)
    if distance > FURTHEST_M:
        raise DatasetError(
            f"By its position {name} was taken {distance / 1000:.1f} km outside the city model.",
            "Is it the right tile, and its reference system right? lodbench city info says where it is.",
        )


def _segmenter_notes(request: PhotoRequest) -> tuple[str, ...]:
    return notes_of(request.segmenter) if request.mask is None else ()


def _notes(photo: PhotoMetadata, frame: MapFrame | None, view: PhotoView, estimate: Estimate) -> list[str]:
    datum = None if frame is None else datum_note(frame)
    notes = [*estimate.notes] if datum is None else [*estimate.notes, datum]
    if photo.orientation > 1:
        notes.append("viewers turn this photo for display (EXIF): camera and mask are of the stored pixels")
    if view.pixels is None:
        notes.append("the photo's pixels cannot be decoded: the overlay shows none")
    if view.camera.distortion:
        notes.append(f"the lens distortion ({view.camera.lens}) was undone before localising")
    if not is_trusted(estimate.probability, estimate.score, view.mask is not None):
        notes.append(_warning(estimate, view.mask is not None))
    return notes


def _warning(estimate: Estimate, has_mask: bool) -> str:
    if has_mask and estimate.score < TRUSTED_OVERLAP:
        reason = f"mask and model overlap by {estimate.score:.2f} only: do not trust this pose"
    else:
        reason = f"this pose is right with a probability of {estimate.probability:.2f} only: do not trust it"
    mask = f"{'mend' if has_mask else 'make'} the mask (lodbench mask PHOTO) and give --mask FILE"
    return f"{reason}; look at the overlay, give a better --center, --height or --heading, or {mask}"


def _sigmas(estimate: Estimate) -> tuple[float, ...] | None:
    if estimate.covariance is None:
        return None
    return tuple(float(v) for v in np.sqrt(np.diagonal(estimate.covariance)))


def _pose_values(pose: Pose) -> dict[str, Any]:
    return {
        "center_m": [float(v) for v in pose.center],
        **pose.euler._asdict(),
        "quat_wxyz": list(pose.quat_wxyz),
        "translation_m": [float(v) for v in pose.translation],
    }
