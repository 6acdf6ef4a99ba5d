"""A COLMAP model into a city's coordinates, by the outlines of its buildings: no ground control points."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.stored_city import OpenCity
from lodbench.datasets.exchange.colmap import read_colmap
from lodbench.datasets.exchange.posed import FoundPose
from lodbench.datasets.map_frame import MapFrame
from lodbench.datasets.own import find_mask, find_photo, shared_files
from lodbench.datasets.query import Entry, Query
from lodbench.datasets.undistort import pinhole_of, undistorted
from lodbench.errors import DatasetError, LodbenchError, QueryFault
from lodbench.execution import Progress
from lodbench.geometry import Camera, Pose
from lodbench.geometry.similarity import FEWEST_POSES, FittedSimilarity, Similarity, fit_similarity
from lodbench.harness.city import open_city, require_near_city
from lodbench.harness.georeference.outputs import require_no_other, write_georeferenced
from lodbench.harness.georeference.request import Georeferenced, GeoreferenceRequest
from lodbench.harness.georeference.start import ROUGH_DEG, ROUGH_M, rough_start
from lodbench.methods import Estimate
from lodbench.methods.measured_calls import localize_flight
from lodbench.methods.protocol import FlightEstimate, SupportsFlights
from lodbench.reporting.answers import is_trusted
from lodbench.segmentation import check_mask, notes_of, resized
from lodbench.segmentation.masks import read_mask
from lodbench.storage import random_stream

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
    fitted = _fitted({i.name: i.pose for i in images}, {name: places[name] for name in used}, city.scene)
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
        hint = "Name the masks as the photos, or give --images and leave --masks out."
        if any(reason.startswith("there is no photo") for _, reason in left_out):
            hint = "--images is the folder of the model's photos, under the names that the model has."
        raise DatasetError(
            f"{usable} of {count} photos can be used, and {FEWEST_POSES} are needed: {reasons}.", hint
        )


def _queries(
    request: GeoreferenceRequest, images: Sequence[FoundPose], rough: Similarity, scene: Scene
) -> tuple[dict[str, Query], list[tuple[str, str]]]:
    """Returns the photos to solve, by name, and those left out, with the reason."""
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
    if request.masks is not None:
        if file is None:
            raise DatasetError(f"{request.masks} holds no mask of it")
        probability = read_mask(file)
    else:
        if file is None or request.segmenter is None:
            raise DatasetError(f"there is no photo of it in {request.images}")
        probability = request.segmenter.segment(Entry(name, "", camera, None, file, None))
    mask = np.asarray(undistorted(check_mask(probability, camera), camera, pinhole))
    width = min(_MASK_WIDTH, mask.shape[1])
    return resized(mask, width, max(1, round(width * pinhole.height / pinhole.width)))


def _solved(request: GeoreferenceRequest, queries: Mapping[str, Query], city: OpenCity) -> FlightEstimate:
    method = request.method
    assert isinstance(method, SupportsFlights)  # noqa: S101 - the command has looked
    streams = [partial(random_stream, request.seed, "georeference", name) for name in queries]
    return localize_flight(method, list(queries.values()), CityMap(city.scene), streams)


def _fitted(model: Mapping[str, Pose], places: Mapping[str, Estimate], scene: Scene) -> FittedSimilarity:
    """Returns the similarity that lays the model on the poses found, weighed by how sure each is."""
    unknown = np.diag([*ROUGH_M, *[ROUGH_DEG] * 3]) ** 2
    spreads = np.array(
        [np.diagonal(unknown if each.covariance is None else each.covariance) for each in places.values()]
    )
    found = [each.pose.shifted(scene.origin) for each in places.values()]
    sigma_m, sigma_deg = np.sqrt(spreads[:, :3]), np.sqrt(spreads[:, 3:].mean(axis=1))
    fitted = fit_similarity([model[name] for name in places], found, sigma_m, sigma_deg)
    # What photos of a flight are wrong about, they are wrong about alike: their number makes nothing surer.
    return replace(fitted, sigmas=fitted.sigmas * math.sqrt(len(places)))
