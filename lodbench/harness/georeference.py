"""A COLMAP model into a city's coordinates, by the outlines of its buildings: no ground control points."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.colmap import read_colmap
from lodbench.datasets.exchange.colmap_moved import write_moved_colmap
from lodbench.datasets.exchange.geojson import camera_feature, footprint_feature, view_feature, write_geojson
from lodbench.datasets.exchange.photogrammetry import write_metashape, write_odm, write_pix4d
from lodbench.datasets.own import find_mask, find_photo, shared_files
from lodbench.datasets.pose_text import FoundPose, read_json
from lodbench.datasets.query import Query
from lodbench.errors import DatasetError, LodbenchError
from lodbench.execution import Progress
from lodbench.geometry import Camera
from lodbench.geometry.similarity import FEWEST_POSES, Similarity
from lodbench.harness.city import open_city, require_near_city
from lodbench.harness.photo.flight_inputs import rough_start
from lodbench.harness.photo.flights import solved_flight
from lodbench.harness.photo.outputs import contradiction_features, ground_below_m
from lodbench.harness.photo.prepare import CityRequest, PhotoRequest, pinhole_mask
from lodbench.methods.georeference import PLACEMENT, Georeference
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
        method: ``georeference``.
        images: Folder that the model's names are relative to; None where nothing is read from photos.
        masks: Folder of masks of the photos as stored, or None for the segmenter.
        start: Rough poses in the city's coordinates, in any known format, or a similarity that this command
            wrote; None for what the photos state.
        seed: Of the search.
    """

    model: Path
    method: Georeference
    images: Path | None = None
    masks: Path | None = None
    start: Path | None = None
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Georeferenced:
    """A reconstruction, placed.

    Attributes:
        placement: How it lies in the city's coordinates: ``PLACEMENT`` of ``method=georeference``.
        cameras: All of the model's, in the city's coordinates.
        left_out: Name and reason of each image that had no part in it.
        findings: What its photos say besides; see the inner method.
        start: Where the rough places came from, in words.
        crs: Reference system, or None.
        files: Written, by what they are.
        notes: What the reader should know.
    """

    placement: Mapping[str, Any]
    cameras: tuple[FoundPose, ...]
    left_out: tuple[tuple[str, str], ...]
    findings: dict[str, Any]
    start: str
    crs: str | None
    files: Mapping[str, Path]
    notes: tuple[str, ...]

    @property
    def used(self) -> dict[str, float]:
        """Returns the images by whose masks it was placed, and how many metres each is from its place."""
        return {name: each["distance_m"] for name, each in self.placement["used"].items()}

    @property
    def untrusted(self) -> list[str]:
        """Returns those among ``used`` whose poses are more likely wrong than right, as far as is known."""
        used = self.placement["used"].items()
        return [name for name, each in used if not is_trusted(each["probability"], each["score"], True)]

    @property
    def is_trusted(self) -> bool:
        """Returns whether most of the images it was placed by are more likely right than wrong."""
        return 2 * len(self.untrusted) < len(self.used)

    def to_json(self) -> dict[str, Any]:
        """Returns plain values for JSON."""
        return {
            **{name: self.placement[name] for name in ("similarity", "sigmas", "middle")},
            "crs": self.crs,
            "start": self.start,
            "used": self.used,
            "trusted": self.is_trusted,
            "untrusted": self.untrusted,
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


def _written(
    placed: Georeferenced,
    similarity: Similarity,
    request: GeoreferenceRequest,
    scene: Scene,
    frame: MapFrame | None,
) -> Georeferenced:
    """Writes a placed reconstruction; returns it with what was written, and what was not and why."""
    out, cameras, crs = request.out, list(placed.cameras), placed.crs
    make_folder(out)
    model, similarity_file = {"model": str(request.model.resolve())}, out / SIMILARITY_FILE
    if not similarity_file.exists():
        # Whose the others are, from the first on: a command that is killed can be given again.
        write_text(similarity_file, json.dumps(model) + "\n")
    writers: dict[str, Callable[[Path], None]] = {
        "colmap": lambda path: write_moved_colmap(request.model, similarity, path),
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
    streams = [partial(random_stream, request.seed, "georeference", query.name) for query in queries]
    solution = solved_flight(request.method, queries, CityMap(city.scene), streams, request.out)
    # Nothing is said of it where the code of a plug-in failed: then each photo has the reason.
    reasons = [(query.name, str(each)) for query, each in zip(queries, solution.estimates, strict=True)]
    placement = solution.findings.get(PLACEMENT, {"used": {}, "left_out": reasons})
    left_out += [(name, reason) for name, reason in placement["left_out"]]
    _require_enough(len(placement["used"]), len(images), left_out)
    laid = placement["similarity"]
    similarity = Similarity(laid["scale"], np.array(laid["rotation"]), np.array(laid["translation"]))
    notes = city.notes() + (notes_of(request.segmenter) if request.masks is None else ()) + start.notes
    placed = Georeferenced(
        placement=placement,
        cameras=tuple(image._replace(pose=similarity.pose(image.pose)) for image in images),
        left_out=tuple(left_out),
        findings={name: value for name, value in solution.findings.items() if name != PLACEMENT},
        start=start.source,
        crs=city.scene.crs,
        files={},
        notes=notes,
    )
    return _written(placed, similarity, request, city.scene, frame)


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
) -> tuple[list[Query], list[tuple[str, str]]]:
    queries: list[Query] = []
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
                mask = _mask(request, image.name, file, image.camera, pinhole)
                query = Query(
                    image.name, "", pinhole, prior, mask, _picture(request, image.name, image.camera)
                )
                queries.append(replace(query, sequence="reconstruction", reconstructed=image.pose))
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
