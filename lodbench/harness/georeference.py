"""A COLMAP model into a city's coordinates, by the outlines of its buildings: no ground control points."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.cache import OpenCity
from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.colmap import read_colmap
from lodbench.datasets.exchange.colmap_moved import write_moved_colmap
from lodbench.datasets.exchange.geojson import camera_feature, footprint_feature, view_feature, write_geojson
from lodbench.datasets.exchange.photogrammetry import write_metashape, write_odm, write_pix4d
from lodbench.datasets.own import find_mask, find_photo, shared_files
from lodbench.datasets.pose_text import FoundPose, read_json
from lodbench.datasets.query import Query
from lodbench.errors import DatasetError, LodbenchError, QueryFault
from lodbench.execution import Progress
from lodbench.geometry import Camera, Pose
from lodbench.geometry.similarity import FEWEST_POSES, FittedSimilarity, Similarity, fit_similarity
from lodbench.harness.city import open_city, require_near_city
from lodbench.harness.photo.flight_inputs import ROUGH_DEG, ROUGH_M, rough_start
from lodbench.harness.photo.flights import solved_flight
from lodbench.harness.photo.outputs import contradiction_features, ground_below_m
from lodbench.harness.photo.prepare import CityRequest, PhotoRequest, pinhole_mask
from lodbench.methods import Estimate, Method
from lodbench.methods.protocol import FlightEstimate, SupportsFlights
from lodbench.photos.camera import pinhole_of
from lodbench.photos.map_frame import MapFrame
from lodbench.reporting.answers import is_trusted
from lodbench.segmentation import notes_of, resized
from lodbench.storage import make_folder, random_stream, write_text


@dataclass(frozen=True, slots=True, kw_only=True)
class GeoreferenceRequest(CityRequest):
    """A reconstruction, and what is known of where it is.

    Attributes:
        model: Folder of a COLMAP model.
        method: Solves flights.
        images: Folder that the model's names are relative to; None where nothing is read from photos.
        masks: Folder of masks of the photos as stored, or None for the segmenter.
        start: Rough poses in the city's coordinates, in any known format, or a similarity that this command
            wrote; None for what the photos state.
        seed: Of the search.
    """

    model: Path
    method: Method
    images: Path | None = None
    masks: Path | None = None
    start: Path | None = None
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Georeferenced:
    """A reconstruction, placed.

    Attributes:
        fitted: From the model to the city's coordinates.
        cameras: All of the model's, in the city's coordinates.
        used: Images by whose masks it was placed, and how far, in metres, each was found from where the
            similarity puts it.
        untrusted: Those among ``used`` whose poses are more likely wrong than right, as far as can be known.
        left_out: Name and reason of each image that had no part in it.
        findings: What its photos say besides; see the method.
        start: Where the rough places came from, in words.
        crs: Reference system, or None.
        files: Written, by what they are.
        notes: What the reader should know.
    """

    fitted: FittedSimilarity
    cameras: tuple[FoundPose, ...]
    used: Mapping[str, float]
    untrusted: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]
    findings: dict[str, Any]
    start: str
    crs: str | None
    files: Mapping[str, Path]
    notes: tuple[str, ...]

    @property
    def is_trusted(self) -> bool:
        """Returns whether most of the images it was placed by are more likely right than wrong."""
        return 2 * len(self.untrusted) < len(self.used)

    def to_json(self) -> dict[str, Any]:
        """Returns plain values for JSON."""
        similarity = self.fitted.similarity
        names = ("east_m", "north_m", "up_m", "about_east_deg", "about_north_deg", "about_up_deg", "scale")
        return {
            "similarity": {
                "scale": similarity.scale,
                "rotation": similarity.rotation.tolist(),
                "translation": similarity.translation.tolist(),
            },
            "sigmas": dict(zip(names, map(float, self.fitted.sigmas), strict=True)),
            "middle": self.fitted.middle.tolist(),
            "crs": self.crs,
            "start": self.start,
            "used": dict(self.used),
            "trusted": self.is_trusted,
            "untrusted": list(self.untrusted),
            "left_out": [list(pair) for pair in self.left_out],
            "files": {name: str(path) for name, path in self.files.items()},
            "notes": list(self.notes),
            "findings": self.findings,
        }


SIMILARITY_FILE = "similarity.json"
_NAMES = {
    "colmap": "colmap",
    "metashape": "metashape_reference.txt",
    "pix4d": "calibrated_external_camera_parameters.txt",
    "odm": "geo.txt",
    "map": "cameras.geojson",
    "map findings": "map_findings.geojson",
}


def require_no_other(out: Path, model: Path) -> None:
    """Refuses a folder that holds the result of another model, or files of somebody else's under its names.

    Raises:
        DatasetError: It does.
    """
    there = [out / name for name in (SIMILARITY_FILE, *_NAMES.values()) if (out / name).exists()]
    if there and _model_of(out / SIMILARITY_FILE) != str(model.resolve()):
        raise DatasetError(
            f"{there[0]} is no result of placing {model} and would be written over.",
            "Name another folder: `--out OTHER`",
        )


def _model_of(file: Path) -> object:
    try:
        return read_json(file).get("model")
    except DatasetError:
        return None


def write_georeferenced(
    placed: Georeferenced, request: GeoreferenceRequest, scene: Scene, frame: MapFrame | None
) -> Georeferenced:
    """Writes a placed reconstruction; returns it with what was written, and what was not and why."""
    out, cameras, crs = request.out, list(placed.cameras), placed.crs
    make_folder(out)
    model, similarity_file = {"model": str(request.model.resolve())}, out / SIMILARITY_FILE
    if not similarity_file.exists():
        # Whose the others are, from the first on: a command that is killed can be given again.
        write_text(similarity_file, json.dumps(model) + "\n")
    writers: dict[str, Callable[[Path], None]] = {
        "colmap": lambda path: write_moved_colmap(request.model, placed.fitted.similarity, path),
        "metashape": lambda path: write_metashape(cameras, path, crs),
        "pix4d": lambda path: write_pix4d(cameras, path),
        "odm": lambda path: write_odm(cameras, path, crs),
    }
    if frame is not None:
        writers["map"] = lambda path: write_geojson(_features(placed, scene, frame), path)
        doubts = contradiction_features(scene, frame, placed.findings, "reconstruction")
        writers["map findings"] = lambda path: write_geojson(doubts, path)
    files, notes = {}, list(placed.notes)
    for name, write in writers.items():
        file = out / _NAMES[name]
        try:
            write(file)
            files[name] = file
        except LodbenchError as fault:
            notes.append(f"{name} was not written: {fault.message}")
    files["similarity"] = similarity_file
    written = replace(placed, files=files, notes=tuple(notes))
    text = json.dumps({**model, **written.to_json()}, indent=1, ensure_ascii=False)
    write_text(similarity_file, text + "\n")
    return written


def _features(placed: Georeferenced, scene: Scene, frame: MapFrame) -> list[dict[str, object]]:
    features = []
    for camera in placed.cameras:
        stated: dict[str, object] = {"name": camera.name, "kind": "estimate"}
        if camera.name in placed.used:
            stated["away_m"] = round(placed.used[camera.name], 3)
        features.append(camera_feature(frame, camera.pose, stated))
        features.append(view_feature(frame, camera.pose, {"name": camera.name}))
        if camera.camera is not None:
            ground = ground_below_m(scene, camera.pose)
            pinhole = pinhole_of(camera.camera)
            shown = footprint_feature(frame, pinhole, camera.pose, ground, {"name": camera.name})
            features += [] if shown is None else [shown]
    return features


Floats = NDArray[np.float64]

# Masks are held at this width, pixels: half as much again as methods look at.
_MASK_WIDTH = 900


def georeference(request: GeoreferenceRequest) -> Georeferenced:
    """Returns a reconstruction in the city's coordinates; writes it in the formats that surveyors load.

    The start is the similarity that lays the model's cameras on rough poses. From there its photos are found
    as one flight; the similarity that lays the model on these poses is the answer.

    Raises:
        LodbenchError: The model, the city or the rough poses cannot be read, too few photos can be used, or
            the folder to be written holds the result of another model.
    """
    require_no_other(request.out, request.model)
    images = list(read_colmap(request.model))
    city = open_city(request.city, request.lod, request.options, request.roof_height)
    frame = None if city.scene.crs is None else MapFrame(city.scene.crs)
    start = rough_start(request, images, frame)
    roughly = [start.similarity.pose(image.pose) for image in images]
    require_near_city("The reconstruction lies", roughly, city.scene)
    queries, left_out = _queries(request, images, start.similarity, city.scene)
    _require_enough(len(queries), len(images), left_out)
    found = _solved(request, queries, city)
    places = {
        name: each for name, each in zip(queries, found.estimates, strict=True) if isinstance(each, Estimate)
    }
    left_out += [
        (name, each.message)
        for name, each in zip(queries, found.estimates, strict=True)
        if isinstance(each, QueryFault)
    ]
    reasons = found.findings.get("reasons", {})
    left_out += [
        (name, reasons.get(name, "it fits nowhere near the others"))
        for name in found.findings.get("lost", [])
    ]
    lost = {name for name, _ in left_out}
    used = [name for name in places if name not in lost]
    _require_enough(len(used), len(images), left_out)
    fitted = _fitted({i.name: i.pose for i in images}, {name: places[name] for name in used})
    notes = city.notes() + (notes_of(request.segmenter) if request.masks is None else ()) + start.notes
    placed = Georeferenced(
        fitted=fitted,
        cameras=tuple(image._replace(pose=fitted.similarity.pose(image.pose)) for image in images),
        used=dict(zip(used, map(float, fitted.distances_m), strict=True)),
        untrusted=tuple(
            name for name in used if not is_trusted(places[name].probability, places[name].score, True)
        ),
        left_out=tuple(left_out),
        findings=found.findings,
        start=start.source,
        crs=city.scene.crs,
        files={},
        notes=notes,
    )
    return write_georeferenced(placed, request, city.scene, frame)


def _require_enough(usable: int, count: int, left_out: Sequence[tuple[str, str]]) -> None:
    if usable < FEWEST_POSES:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out[:3])
        hint = "Name the masks as the photos, or give `--images` and leave `--masks` out."
        if any(reason.startswith("there is no photo") for _, reason in left_out):
            hint = "`--images` is the folder of the model's photos, under the names that the model has."
        raise DatasetError(
            f"{usable} of {count} photos can be used, and {FEWEST_POSES} are needed: {reasons}.", hint
        )


def _queries(
    request: GeoreferenceRequest, images: Sequence[FoundPose], rough: Similarity, scene: Scene
) -> tuple[dict[str, Query], list[tuple[str, str]]]:
    queries: dict[str, Query] = {}
    shared = shared_files(_file(request, image.name) for image in images)
    left_out: list[tuple[str, str]] = []
    with Progress("masks", len(images)) as progress:
        for image in images:
            try:
                if image.camera is None:
                    raise DatasetError(image.no_camera or "it has no camera")
                file = _file(request, image.name)
                if file in shared:
                    raise DatasetError(f"{file} is of other images as well: keep the model's folders")
                pinhole = pinhole_of(image.camera)
                prior = rough.pose(image.pose).shifted(-scene.origin)
                queries[image.name] = Query(
                    image.name, "", pinhole, prior, _mask(request, image.name, file, image.camera, pinhole),
                    image=_picture(request, image.name, image.camera),
                    sequence="reconstruction", reconstructed=image.pose,
                )  # fmt: skip
            except LodbenchError as fault:
                left_out.append((image.name, fault.message.rstrip(".")))
            progress.advance()
    return queries, left_out


def _file(request: GeoreferenceRequest, name: str) -> Path | None:
    """Returns an image's mask, or the photo that it is made of; None where there is neither."""
    if request.masks is not None:
        return find_mask(request.masks, name)
    return None if request.images is None else find_photo(request.images, name)


def _picture(request: GeoreferenceRequest, name: str, camera: Camera) -> Path | None:
    """Returns the photo of an image, where it is as a pinhole shows it: its edges refine and check."""
    if request.images is None or camera.distortion:
        return None
    return find_photo(request.images, name)


def _mask(
    request: GeoreferenceRequest, name: str, file: Path | None, camera: Camera, pinhole: Camera
) -> NDArray[np.float32]:
    """Returns the probability of building in a photo as its pinhole sees it, at a size that methods need."""
    has_masks = request.masks is not None
    if file is None:
        raise DatasetError(
            f"{request.masks} holds no mask of it"
            if has_masks
            else f"there is no photo of it in {request.images}"
        )
    photo = PhotoRequest(
        city=request.city,
        out=request.out,
        segmenter=request.segmenter,
        photo=file,
        mask=file if has_masks else None,
    )
    mask = pinhole_mask(photo, camera, pinhole, name)
    width = min(_MASK_WIDTH, mask.shape[1])
    return resized(mask, width, max(1, round(width * pinhole.height / pinhole.width)))


def _solved(request: GeoreferenceRequest, queries: Mapping[str, Query], city: OpenCity) -> FlightEstimate:
    method = request.method
    assert isinstance(method, SupportsFlights)  # noqa: S101 - the command has looked
    streams = [partial(random_stream, request.seed, "georeference", name) for name in queries]
    return solved_flight(method, list(queries.values()), CityMap(city.scene), streams, request.out)


def _fitted(model: Mapping[str, Pose], places: Mapping[str, Estimate]) -> FittedSimilarity:
    """Returns the similarity that lays the model on the poses found, weighed by how sure each is."""
    unknown = np.diag([*ROUGH_M, *[ROUGH_DEG] * 3]) ** 2
    spreads = np.array(
        [np.diagonal(unknown if each.covariance is None else each.covariance) for each in places.values()]
    )
    found = [each.pose for each in places.values()]
    sigma_m, sigma_deg = np.sqrt(spreads[:, :3]), np.sqrt(spreads[:, 3:].mean(axis=1))
    fitted = fit_similarity([model[name] for name in places], found, sigma_m, sigma_deg)
    # What photos of a flight are wrong about, they are wrong about alike: their number makes nothing surer.
    return replace(fitted, sigmas=fitted.sigmas * math.sqrt(len(places)))
