"""Photos of flights over one city: told apart, localised jointly, and what was left out and why."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.geojson import write_geojson
from lodbench.datasets.map_frame import MapFrame
from lodbench.datasets.own import find_mask
from lodbench.datasets.photo_flights import Flight, split_flights
from lodbench.datasets.pictures import encoded, read_picture
from lodbench.datasets.query import Query
from lodbench.datasets.undistort import undistorted
from lodbench.errors import LodbenchError, QueryFault
from lodbench.execution import Progress
from lodbench.geometry import Pose
from lodbench.harness.flights.map_findings import doubt_features
from lodbench.harness.photo.flight_answer import FlightAnswer
from lodbench.harness.photo.flight_pages import page_of_photos
from lodbench.harness.photo.localize import inputs_of, open_map, write_answer
from lodbench.harness.photo.many import Answers, PhotoAnswer, numbered, write_answers
from lodbench.harness.photo.prepare import PreparedPhoto, prepare_photo
from lodbench.harness.photo.request import PhotoRequest
from lodbench.methods import Estimate
from lodbench.methods.asking import localize_flight
from lodbench.methods.protocol import FlightEstimate, SupportsFlights
from lodbench.segmentation import resized
from lodbench.storage import file_digest, random_stream, write_bytes, write_text

FLIGHTS_FILE, FINDINGS_FILE = "flights.json", "map_findings.geojson"
# Masks of a flight are held at this width, pixels: half as much again as methods look at.
_MASK_WIDTH = 900
# Undistorted copies of photos, by whose features flights are tied together, are no wider, pixels.
_PICTURE_WIDTH = 1600


def localize_flights(request: PhotoRequest, photos: Sequence[Path], masks: Path | None) -> Answers:
    """Returns what became of photos that flights took, each flight solved as a whole; writes all of it.

    A photo that cannot be used is left out with the reason; the others are solved.

    Args:
        request: As for one photo, its method one for flights; ``photo`` and ``mask`` are set for each.
        photos: The files.
        masks: Folder of masks named as the photos, or None.

    Raises:
        LodbenchError: The city cannot be read, or the method does not work on photos.
    """
    assert request.method is not None  # noqa: S101 - the caller has chosen
    requires = inputs_of(request.method)
    place = open_map(request)
    names = _names(photos)
    masks_of, failures = _masks_of(photos, masks)
    ready: dict[int, tuple[PreparedPhoto, Pose]] = {}
    with Progress("masks", len(photos)) as progress:
        for row, photo in enumerate(photos):
            if row not in failures:
                try:
                    wanted = replace(request, photo=photo, mask=masks_of[row])
                    prepared = _with_small_mask(prepare_photo(wanted, requires))
                    ready[row] = prepared, prepared.prior(place.scene, place.frame)
                except LodbenchError as fault:
                    failures[row] = fault.message.rstrip(".")
            progress.advance()
    rows = list(ready)
    city_map = CityMap(place.scene)
    flights: list[FlightAnswer] = []
    estimates: dict[int, Estimate] = {}
    for flight in split_flights([(photos[row], ready[row][0].stated) for row in rows]):
        mine = [rows[row] for row in flight.rows]
        found = _solve(request, {names[row]: ready[row] for row in mine}, city_map)
        for row, estimate in zip(mine, found.estimates, strict=True):
            if isinstance(estimate, QueryFault):
                failures[row] = estimate.message
            else:
                estimates[row] = estimate
        taken = _taken(flight, [names[row] for row in rows])
        name, paths = f"flight {len(flights) + 1}", tuple(photos[row] for row in mine)
        flights.append(FlightAnswer(name, paths, tuple(taken), found.findings))
    answers = []
    with Progress("overlays", len(photos)) as progress:
        for row, photo in enumerate(photos):
            located = None
            if row in estimates:
                prepared, prior = ready[row]
                located = write_answer(prepared, prepared.view(), place, prior, estimates[row])
            answers.append(PhotoAnswer(photo, located, failures.get(row, ""), _flight_of(photo, flights)))
            progress.advance()
    written = write_answers(request.out, answers, flights)
    _write_findings(written, place.scene, place.frame)
    for flight_answer in flights:
        page = page_of_photos(flight_answer, dict(zip(photos, names, strict=True)), answers, place.scene)
        write_text(written.page(flight_answer), page)
    return written


def _names(photos: Sequence[Path]) -> list[str]:
    """Returns what photos are called: by their file names, with as many folders as tell them apart."""
    names = [photo.name for photo in photos]
    longest = max(len(photo.parts) for photo in photos)
    for depth in range(2, longest + 1):
        counts = Counter(names)
        names = [
            "/".join(photo.parts[-depth:]) if counts[name] > 1 else name
            for photo, name in zip(photos, names, strict=True)
        ]
    return names


def _masks_of(photos: Sequence[Path], masks: Path | None) -> tuple[list[Path | None], dict[int, str]]:
    """Returns the mask of each photo, and why some photos are left out, by row.

    A mask that may be of two photos is of neither; a photo that is another's copy says nothing new.
    """
    found = [find_mask(masks, f"{photo.parent.name}/{photo.name}") for photo in photos]
    users: dict[Path | None, list[int]] = defaultdict(list)
    for row, mask in enumerate(found):
        users[mask].append(row)
    reasons: dict[int, str] = {}
    first_of: dict[str, Path] = {}
    for row, (photo, mask) in enumerate(zip(photos, found, strict=True)):
        original = first_of.setdefault(file_digest(photo), photo)
        if original != photo:
            reasons[row] = f"it is a copy of {original}"
        elif masks is not None and mask is None:
            reasons[row] = f"{masks} holds no mask of it"
        elif mask is not None and len(users[mask]) > 1:
            others = ", ".join(str(photos[other]) for other in users[mask] if other != row)
            own = Path(photo.parent.name) / f"{photo.stem}.png"
            reasons[row] = f"the mask {mask} may be of {others} as well: name it {own}"
    return found, reasons


def _with_small_mask(photo: PreparedPhoto) -> PreparedPhoto:
    if photo.mask is None or photo.mask.shape[1] <= _MASK_WIDTH:
        return photo
    height = max(1, round(_MASK_WIDTH * photo.pinhole.height / photo.pinhole.width))
    return replace(photo, mask=resized(photo.mask, _MASK_WIDTH, height))


def _solve(
    request: PhotoRequest, photos: Mapping[str, tuple[PreparedPhoto, Pose]], city_map: CityMap
) -> FlightEstimate:
    """Returns the answers to the photos of a flight, in the city's coordinates."""
    method, origin = request.method, city_map.scene.origin
    assert isinstance(method, SupportsFlights)  # noqa: S101 - the caller has looked
    with TemporaryDirectory() as folder:
        queries = []
        for number, (name, (photo, prior)) in enumerate(photos.items()):
            image = _picture(photo, Path(folder), number)
            queries.append(
                Query(name, "", photo.pinhole, prior.shifted(-origin), photo.mask, image, sequence="flight")
            )
        streams = [partial(random_stream, request.seed, "localize", "photo") for _ in queries]
        found = localize_flight(method, queries, city_map, streams)
    estimates = [
        each
        if isinstance(each, QueryFault)
        else replace(
            each,
            pose=each.pose.shifted(origin),
            alternatives=tuple(pose.shifted(origin) for pose in each.alternatives),
        )
        for each in found.estimates
    ]
    return FlightEstimate(estimates, found.findings)


def _picture(photo: PreparedPhoto, folder: Path, number: int) -> Path | None:
    """Returns a file of a photo as its pinhole sees it: the photo itself, or a smaller copy undistorted.

    None where it cannot be decoded: methods for flights can do without.
    """
    if not photo.camera.distortion:
        return photo.request.photo
    pixels = read_picture(photo.request.photo)
    if pixels is None:
        return None
    width = min(_PICTURE_WIDTH, pixels.shape[1])
    height = max(1, round(width * photo.camera.height / photo.camera.width))
    small = undistorted(_scaled(pixels, width, height), photo.camera, photo.pinhole)
    path = folder / f"{number}.jpg"
    write_bytes(path, encoded(small, path.suffix))
    return path


def _scaled(pixels: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    import cv2

    resized_pixels = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized_pixels, dtype=np.uint8)


def _taken(flight: Flight, names: Sequence[str]) -> list[str]:
    """Returns with what and when a flight was taken, and whose clock is odd."""
    when = "no clock says when"
    if flight.started is not None and flight.ended is not None:
        when = f"{flight.started:%Y-%m-%d %H:%M:%S} to {flight.ended:%H:%M:%S}"
    first, last = names[flight.rows[0]], names[flight.rows[-1]]
    lines = [f"{len(flight.rows)} photos, {first} to {last}, {flight.camera}, {when}"]
    if flight.odd_clocks:
        odd = [names[row] for row in flight.odd_clocks]
        listed = ", ".join(odd[:3]) + (", ..." if len(odd) > 3 else "")
        lines.append(f"the clock jumps at {len(odd)} photos, which are placed by name: {listed}")
    return lines


def _flight_of(photo: Path, flights: Sequence[FlightAnswer]) -> str:
    return next((flight.name for flight in flights if photo in flight.photos), "")


def _write_findings(answers: Answers, scene: Scene, frame: MapFrame | None) -> None:
    left_out = [
        {"photo": str(each.photo), "reason": each.failure} for each in answers.photos if each.found is None
    ]
    values = {"flights": [flight.to_json() for flight in answers.flights], "left_out": left_out}
    text = json.dumps(values, indent=1, ensure_ascii=False)
    write_text(numbered(answers.folder / FLIGHTS_FILE, answers.number), text + "\n")
    if frame is not None:
        features = [
            feature
            for flight in answers.flights
            for feature in doubt_features(scene, frame, flight.findings.get("buildings", []), flight.name)
        ]
        write_geojson(features, numbered(answers.folder / FINDINGS_FILE, answers.number))
