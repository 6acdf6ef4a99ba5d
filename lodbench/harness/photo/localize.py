"""One photo and a city: from its metadata to a pose, a picture and a map."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lodbench.citymodel.cache import OpenCity
from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.geojson import write_geojson
from lodbench.datasets.inputs import Input, declared_inputs, require_inputs
from lodbench.evaluation import pose_error
from lodbench.geometry import Pose
from lodbench.harness.city import HEIGHT_HINT, height_above_m, open_city
from lodbench.harness.photo import LocalizedPhoto, PhotoRequest
from lodbench.harness.photo.outputs import PhotoView, photo_features, write_photo_overlay
from lodbench.harness.photo.prepare import PreparedPhoto, pinhole_mask, prepare_photo, undistorted_photo
from lodbench.harness.tracebacks import told_as_fault
from lodbench.methods import Estimate, Method
from lodbench.methods.localize import localize
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.methods.protocol import SupportsPriorWidth
from lodbench.methods.search import NothingFits
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import place_notes, refused_notes, xmp_note
from lodbench.rendering import Renderer, make_renderer
from lodbench.reporting.answers import TRUSTED_OVERLAP, is_trusted, probability_text
from lodbench.segmentation import notes_of
from lodbench.storage import file_digest, make_folder, write_text
from lodbench.storage.json_text import parse_json


@contextmanager
def telling_of_depth(prior: Pose, scene: Scene) -> Iterator[None]:
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


# What one photo has; masks come with --mask or from a segmenter.
_GIVEN = frozenset({Input.MASK, Input.MASK_ON_DEMAND, Input.IMAGE, Input.TILT, Input.HEIGHT, Input.MAP})


STEPS = 3


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
        reported = told_as_fault(f"method {method.name}", request.out, request.photo.name)
        with telling_of_depth(prior, place.scene), reported:
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
    photo: PreparedPhoto,
    view: PhotoView,
    place: OpenMap,
    prior: Pose,
    estimate: Estimate,
) -> LocalizedPhoto:
    """Writes a photo's overlay, map and numbers, never over those of another photo; returns the answer.

    Args:
        photo: The photo.
        view: Its pixels.
        place: The map.
        prior: In the city's coordinates.
        estimate: Likewise.
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
    found = LocalizedPhoto(
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
    values = {"sha256": digest, **found.to_json()}
    # First what says whose files these are: a command that is given again after a kill writes over its own.
    write_text(request.out / f"{label}.json", _json(values))
    write_photo_overlay(overlay, view, place.renderer, prior, estimate)
    if geojson is not None:
        write_geojson(features, geojson)
    return found


def _json(values: dict[str, Any]) -> str:
    return json.dumps(values, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


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
