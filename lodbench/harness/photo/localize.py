"""One photo and a city: from its metadata to a pose, a picture and a map."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.cache import OpenCity
from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.geojson import write_geojson
from lodbench.datasets.inputs import Input, declared_inputs, require_inputs
from lodbench.datasets.pose_text import format_camera
from lodbench.evaluation import PoseError, pose_error
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.harness.city import HEIGHT_HINT, height_above_m, open_city
from lodbench.harness.photo.outputs import PhotoView, photo_features, write_photo_overlay
from lodbench.harness.photo.prepare import (
    PhotoRequest,
    PreparedPhoto,
    pinhole_mask,
    prepare_photo,
    undistorted_photo,
)
from lodbench.harness.tracebacks import reported_as_fault
from lodbench.methods import Estimate, Method
from lodbench.methods.fits import NothingFits
from lodbench.methods.localize import localize
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.methods.protocol import SupportsPriorWidth
from lodbench.photos.map_frame import GeoPose, MapFrame
from lodbench.photos.measurements import place_notes, refused_notes, xmp_note
from lodbench.rendering import Renderer, make_renderer
from lodbench.reporting.answers import TRUSTED_OVERLAP, UNTRUSTED, is_trusted, probability_text, trust_word
from lodbench.segmentation import notes_of
from lodbench.storage import file_digest, make_folder, write_text
from lodbench.storage.json_text import finite, parse_json

_SIGMA_NAMES = ("x_m", "y_m", "z_m", "pitch_deg", "roll_deg", "yaw_deg")
# What photos have; masks come with --mask or from a segmenter, a flight's other poses from a reconstruction.
_GIVEN = frozenset(
    {
        *(Input.MASK, Input.MASK_ON_DEMAND, Input.IMAGE, Input.TILT, Input.HEIGHT, Input.MAP),
        Input.RECONSTRUCTION,
    }
)
STEPS = 3


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
        score: Of the method: the overlap (IoU) of mask and model for LoD-Loc v2; NaN where it has none.
        probability: That the pose is within 2 m and 2 degrees, where the method knows it.
        covariance: (6, 6) of the error in x, y, z (metres), pitch, roll and yaw (degrees), where it knows it.
        sigmas: Standard deviations of x, y, z (metres), pitch, roll and yaw (degrees), where it knows them.
        alternatives: Other poses that fit nearly as well, in the city's coordinates, best first.
        alternative_probabilities: Of each, where the method knows them; else empty.
        is_trusted: Whether the pose is more likely right than wrong, as far as can be known.
        place: Where on Earth, or None without a reference system.
        camera: Pinhole that was localised.
        stored_camera: Of the photo as stored, lens included.
        camera_source: Where its numbers came from.
        lens_percent: Standard deviation of its focal length, percent; None for one that was calibrated.
        camera_sigmas: Standard deviations of all of the camera's numbers.
        overlay: Picture written.
        geojson: Map written, or None without a reference system.
        notes: What the reader should know.
        is_laser_used: Whether pose and covariance include a laser's range.
        method_notes: Those of them that the method gives to this very answer.
        features: Of the map.
        thumbnail: A small JPEG of the photo as the pinhole sees it; None where it cannot be decoded.
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
    alternative_probabilities: tuple[float, ...]
    is_trusted: bool
    place: GeoPose | None
    camera: Camera
    stored_camera: Camera
    camera_source: str
    lens_percent: float | None
    camera_sigmas: CameraSigmas
    overlay: Path
    geojson: Path | None
    notes: tuple[str, ...]
    is_laser_used: bool = False
    method_notes: tuple[str, ...] = ()
    features: tuple[dict[str, Any], ...] = ()
    thumbnail: bytes | None = None

    @property
    def trust(self) -> str:
        """Returns how far it may be trusted, in a word; "-" where nothing tells."""
        if not self.is_trusted:
            return UNTRUSTED
        return "-" if self.probability is None else trust_word(self.probability)

    @property
    def view(self) -> Path:
        """Returns the file that shows it over the city in three dimensions, where that was written."""
        return self.overlay.with_name(f"{self.overlay.stem.removesuffix('_overlay')}_3d.html")

    def to_json(self) -> dict[str, Any]:
        """Returns plain values for JSON, units in the names; None for a number that is none."""
        values = {
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
            "alternatives": [
                _pose_values(pose) | {"probability": probability}
                for pose, probability in zip_longest(self.alternatives, self.alternative_probabilities)
            ],
            "trusted": self.is_trusted,
            "trust": self.trust,
            "camera": {
                "colmap": [*self.camera.to_colmap()],
                "as_stored": format_camera("", self.stored_camera).strip(),
                "source": self.camera_source,
                "lens_percent": self.lens_percent,
                "sigmas": asdict(self.camera_sigmas),
            },
            "overlay": str(self.overlay),
            "geojson": None if self.geojson is None else str(self.geojson),
            "notes": list(self.notes),
            **({"laser_used": True} if self.is_laser_used else {}),
        }
        plain: dict[str, Any] = finite(values)
        return plain


def _pose_values(pose: Pose) -> dict[str, Any]:
    return {
        "center_m": [float(v) for v in pose.center],
        **pose.euler._asdict(),
        "quat_wxyz": list(pose.quat_wxyz),
        "translation_m": [float(v) for v in pose.translation],
    }


@contextmanager
def _noting_depth(prior: Pose, scene: Scene) -> Iterator[None]:
    """Adds to the fault of a photo that nothing fits that its rough pose lies below the whole city.

    Rough heights are off by tens of metres, so such a prior is no fault of its own.
    """
    try:
        yield
    except NothingFits as fault:
        height = height_above_m(prior, scene)
        if height >= 0:
            raise
        words = (
            f"{fault.message.rstrip('.')}; its rough place is {-height:.0f} m below the city's lowest point"
        )
        raise NothingFits(words, HEIGHT_HINT) from fault


def localize_photo(
    request: PhotoRequest,
    advance: Callable[[], None] = lambda: None,
    opened: Callable[[], OpenMap] | None = None,
) -> LocalizedPhoto:
    """Returns the pose of a photo, and writes its overlay and map.

    Args:
        request: What to localise, and how.
        advance: Called after each of ``STEPS`` steps: photo and mask, city, search.
        opened: Returns the request's city, where many photos share it.

    Raises:
        LodbenchError: The photo, its metadata, mask or camera, or the city is missing or not fit, or a
            plug-in's code raised; nothing is written then but where it did.
    """
    method = request.method or LodLocV2()
    requires = inputs_of(method)
    photo = prepare_photo(request, requires)
    view = photo.view()
    advance()
    place = open_map(request) if opened is None else opened()
    prior = photo.prior(place.scene, place.frame)
    advance()
    with TemporaryDirectory() as folder:
        image = undistorted_photo(view, Path(folder)) if Input.IMAGE in requires else None
        reported = reported_as_fault(f"method {method.name}", request.out, request.photo.name)
        with _noting_depth(prior, place.scene), reported:
            estimate = localize(
                place.scene,
                photo.pinhole,
                prior,
                photo.mask,
                image=image,
                method=method,
                seed=request.seed,
                threads=request.threads,
                lens_percent=photo.lens_percent,
                camera_sigmas=photo.camera_sigmas,
                measured=photo.measured,
                segment=lambda pose: pinhole_mask(request, photo.camera, photo.pinhole),
            )
    advance()
    if estimate.mask is None:
        return write_answer(photo, view, place, prior, estimate)
    photo = replace(photo, mask=estimate.mask)
    return write_answer(photo, photo.view(), place, prior, estimate)


def inputs_of(method: Method) -> frozenset[str]:
    """Returns what a method requires of photos.

    Raises:
        ConfigError: They have not all of it.
    """
    requires = frozenset(declared_inputs(method, "requires", {Input.MASK}))
    require_inputs(f"--method {method.name}", requires, _GIVEN, "a single photo has none")
    return requires


@dataclass(frozen=True, slots=True, eq=False)
class OpenMap:
    """The city of a request."""

    city: OpenCity
    frame: MapFrame | None
    renderer: Renderer

    @property
    def scene(self) -> Scene:
        """Returns the city's triangles."""
        return self.city.scene


def open_map(request: PhotoRequest) -> OpenMap:
    """Returns the city of a request.

    Raises:
        LodbenchError: It cannot be read, or its coordinates are not in metres.
    """
    city = open_city(request.city, request.lod, request.options, request.roof_height)
    frame = None if city.scene.crs is None else MapFrame(city.scene.crs)
    return OpenMap(city, frame, make_renderer("silhouette", city.scene))


def write_answer(
    photo: PreparedPhoto, view: PhotoView, place: OpenMap, prior: Pose, estimate: Estimate
) -> LocalizedPhoto:
    """Writes a photo's overlay, map and numbers, never over those of another photo; returns the answer.

    Prior and estimate are in the city's coordinates.
    """
    request, name, features = photo.request, photo.request.photo.name, []
    scene, frame = place.scene, place.frame
    if frame is not None:
        features = photo_features(frame, name, photo.pinhole, scene, prior, estimate)
    make_folder(request.out)
    digest = file_digest(request.photo)
    label = _label(request.out, request.photo.stem, digest)
    overlay = request.out / f"{label}_overlay.png"
    geojson = request.out / f"{label}.geojson" if features else None
    has_mask = photo.mask is not None
    answer = LocalizedPhoto(
        photo=name,
        crs=scene.crs,
        lod=scene.lod,
        pose=estimate.pose,
        prior=prior,
        moved=pose_error(estimate.pose, prior),
        score=float(estimate.score),
        probability=estimate.probability,
        covariance=estimate.covariance,
        sigmas=_sigmas(estimate),
        alternatives=estimate.alternatives,
        alternative_probabilities=estimate.alternative_probabilities,
        is_trusted=is_trusted(estimate.probability, estimate.score, has_mask),
        place=None if frame is None else frame.place_of(estimate.pose),
        camera=photo.pinhole,
        stored_camera=photo.camera,
        camera_source=photo.camera_source,
        lens_percent=photo.lens_percent,
        camera_sigmas=photo.camera_sigmas,
        overlay=overlay,
        geojson=geojson,
        notes=_notes(photo, place, view, estimate),
        is_laser_used=estimate.is_laser_used,
        method_notes=estimate.notes,
        features=tuple(features),
        thumbnail=view.thumbnail(),
    )
    text = json.dumps({"sha256": digest, **answer.to_json()}, indent=2, ensure_ascii=False, allow_nan=False)
    # First what says whose files these are: a command that is given again after a kill writes over its own.
    write_text(request.out / f"{label}.json", text + "\n")
    write_photo_overlay(overlay, view, place.renderer, prior, estimate)
    if geojson is not None:
        write_geojson(features, geojson)
    return answer


def _label(out: Path, stem: str, digest: str) -> str:
    """Returns what a photo's files are called: its stem, numbered where another photo has that name."""
    for number in itertools.count(1):
        label = stem if number == 1 else f"{stem}_{number}"
        try:
            if parse_json((out / f"{label}.json").read_text(encoding="utf-8"))["sha256"] == digest:
                return label
        except FileNotFoundError:
            if not (out / f"{label}_overlay.png").exists():
                return label
        except (OSError, ValueError, KeyError, TypeError):
            continue  # a file of somebody else's
    raise AssertionError("numbers do not end")


def _notes(photo: PreparedPhoto, place: OpenMap, view: PhotoView, estimate: Estimate) -> tuple[str, ...]:
    notes = [*place.city.notes()]
    if photo.mask is not None and photo.request.mask is None:
        notes += notes_of(photo.request.segmenter)
    if estimate.mask is not None and photo.request.segmenter is not None:
        notes.append(f"the mask was made by {photo.request.segmenter.name}")
    request = photo.request
    notes += estimate.notes
    notes += place_notes(place.frame, () if request.has_height else (photo.stated,), request.heights)
    notes += () if request.start is None else request.start.notes
    known = photo.measured
    notes += filter(None, [xmp_note([photo.stated]), "" if known is None else known.note])
    notes += refused_notes([photo.stated])
    if photo.stated.orientation > 1:
        notes.append("EXIF rotates this photo for display: camera and mask refer to the pixels as stored")
    if photo.stated.is_turned and request.given.roll_deg is None and request.start is None:
        notes.append(
            "the photo was rotated after capture (its size differs from EXIF's): give --roll 90 or -90"
        )
    if view.pixels is None:
        notes.append("the photo's pixels cannot be decoded: the overlay shows none")
    if view.camera.distortion:
        notes.append(f"the lens distortion ({view.camera.lens}) was corrected before localising")
    if not is_trusted(estimate.probability, estimate.score, view.mask is not None):
        notes.append(_warning(photo, estimate))
    return tuple(notes)


def _warning(photo: PreparedPhoto, estimate: Estimate) -> str:
    request, has_mask = photo.request, photo.mask is not None
    if has_mask and estimate.score < TRUSTED_OVERLAP:
        reason = f"unreliable pose: IoU of mask and model is only {estimate.score:.2f}"
    else:
        reason = f"unreliable pose: its probability is only {probability_text(estimate.probability or 0.0)}"
    mask = f"{'correct' if has_mask else 'make'} the mask (lodbench mask PHOTO) and give --mask FILE"
    better = "give a better position, --height or --heading"
    if request.start is not None:
        better = f"give a better pose in {request.start.source}"
    elif photo.stated.gimbal_roll_deg is None and request.given.roll_deg is None:
        better = "give a better position, --height, --heading or --roll (0 was assumed)"
    if isinstance(request.method, SupportsPriorWidth):
        better += " or a wider --prior-range"
    return f"{reason}; check the overlay, {better}, or {mask}"


def _sigmas(estimate: Estimate) -> tuple[float, ...] | None:
    if estimate.covariance is None:
        return None
    return tuple(float(v) for v in np.sqrt(np.diagonal(estimate.covariance)))
