"""Photos of flights over one city: told apart, localised jointly, what was left out and why; their pages."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.geojson import write_geojson
from lodbench.datasets.query import Query
from lodbench.errors import LodbenchError, QueryFault
from lodbench.evaluation import PoseError
from lodbench.execution import Progress
from lodbench.geometry import Pose
from lodbench.harness.map_findings import city_and_marks, contradiction_features
from lodbench.harness.photo import PhotoRequest
from lodbench.harness.photo.flight_inputs import (
    masks_of,
    names_of,
    picture_file,
    poses_in_model,
    tied_notes,
    with_small_mask,
)
from lodbench.harness.photo.localize import OpenMap, inputs_of, open_map, write_answer
from lodbench.harness.photo.many import (
    FINDINGS_FILE,
    FLIGHTS_FILE,
    Answers,
    FlightAnswer,
    PhotoAnswer,
    hint_for_many,
    numbered,
    write_answers,
)
from lodbench.harness.photo.prepare import PreparedPhoto, prepare_photo
from lodbench.harness.tracebacks import told_as_fault
from lodbench.methods import Estimate
from lodbench.methods.localize import localize_flight
from lodbench.methods.protocol import FlightEstimate, Streams, SupportsFlights
from lodbench.photos.files import Flight, split_flights
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.notes import height_notes, refused_notes
from lodbench.photos.pictures import read_picture
from lodbench.reporting.aligned_text import count_of
from lodbench.reporting.answers import reasons_for_doubt
from lodbench.reporting.flight_words import PriorSource, chosen_for_pictures, flight_page, photo_on_page
from lodbench.reporting.map_figure import Underlay
from lodbench.reporting.overlays import jpeg_bytes
from lodbench.reporting.page import Picture
from lodbench.storage import random_stream, write_text
from lodbench.storage.json_text import finite


def localize_flights(
    request: PhotoRequest,
    photos: Sequence[Path],
    masks: Path | None,
    reconstruction: Path | None = None,
    imagery: Underlay | None = None,
) -> Answers:
    """Returns what became of photos that flights took, each flight solved as a whole; writes all of it.

    A photo that cannot be used is left out with the reason; the others are solved.

    Args:
        request: As for one photo, its method one for flights; ``photo`` and ``mask`` are set for each.
        photos: The files.
        masks: Folder of masks named as the photos, or None.
        reconstruction: COLMAP model whose images are called as the photos, which ties these together.
        imagery: What lies under the maps of the flights' pages.

    Raises:
        LodbenchError: The city or the model cannot be read, the model has none of the photos, or the method
            does not work on photos.
    """
    known = poses_in_model(reconstruction, photos)
    place = open_map(request)
    names = names_of(photos)
    own_masks, failures = masks_of(photos, masks)
    hints: dict[int, str] = {}
    ready = _ready(request, photos, own_masks, place, failures, hints)
    rows = list(ready)
    city_map = CityMap(place.scene)
    flights: list[FlightAnswer] = []
    estimates: dict[int, Estimate] = {}
    for flight in split_flights([(photos[row], ready[row][0].stated) for row in rows]):
        mine = [rows[row] for row in flight.rows]
        found = _solve(request, {names[row]: ready[row] for row in mine}, city_map, known)
        for row, estimate in zip(mine, found.estimates, strict=True):
            if isinstance(estimate, QueryFault):
                failures[row] = estimate.message
            else:
                estimates[row] = estimate
        taken = _taken(flight, [names[row] for row in rows])
        taken += tied_notes(reconstruction, [photos[row] for row in mine], known)
        taken += refused_notes([ready[row][0].stated for row in mine])
        if not request.has_height:
            taken += height_notes([ready[row][0].stated for row in mine], request.heights)
        name, paths = f"flight {len(flights) + 1}", tuple(photos[row] for row in mine)
        source: PriorSource = "metadata" if request.start is None else "poses"
        flights.append(FlightAnswer(name, paths, tuple(taken), found.findings, source))
    answers = []
    with Progress("overlays", len(photos)) as progress:
        for row, photo in enumerate(photos):
            located = None
            if row in estimates:
                prepared, prior = ready[row]
                located = write_answer(prepared, prepared.view(), place, prior, estimates[row])
            reason, flight_name = failures.get(row, ""), _flight_of(photo, flights)
            answers.append(PhotoAnswer(photo, located, reason, flight_name, hints.get(row, "")))
            progress.advance()
    written = write_answers(request.out, answers, flights)
    _write_findings(written, place.scene, place.frame)
    for flight_answer in flights:
        page = page_of_photos(
            flight_answer,
            dict(zip(photos, names, strict=True)),
            answers,
            place.scene,
            written.view.name if written.found else "",
            imagery,
        )
        write_text(written.page(flight_answer), page)
    return written


def _ready(
    request: PhotoRequest,
    photos: Sequence[Path],
    masks: Sequence[Path | None],
    place: OpenMap,
    failures: dict[int, str],
    hints: dict[int, str],
) -> dict[int, tuple[PreparedPhoto, Pose]]:
    """Returns the photos that can be used, with their rough poses, by row; fills in why others cannot.

    ``hints`` receives what would help these.
    """
    assert request.method is not None  # noqa: S101 - the caller has chosen
    requires = inputs_of(request.method)
    ready: dict[int, tuple[PreparedPhoto, Pose]] = {}
    with Progress("masks", len(photos)) as progress:
        for row, photo in enumerate(photos):
            if row not in failures:
                try:
                    wanted = replace(request, photo=photo, mask=masks[row])
                    prepared = with_small_mask(prepare_photo(wanted, requires))
                    ready[row] = prepared, prepared.prior(place.scene, place.frame)
                except LodbenchError as fault:
                    failures[row], hints[row] = fault.message.rstrip("."), hint_for_many(fault)
            progress.advance()
    return ready


def _solve(
    request: PhotoRequest,
    photos: Mapping[str, tuple[PreparedPhoto, Pose]],
    city_map: CityMap,
    known: Mapping[Path, Pose],
) -> FlightEstimate:
    """Returns the answers to the photos of a flight, in the city's coordinates."""
    method, origin = request.method, city_map.scene.origin
    assert isinstance(method, SupportsFlights)  # noqa: S101 - the caller has looked
    with TemporaryDirectory() as folder:
        queries = []
        for number, (name, (photo, prior)) in enumerate(photos.items()):
            image = picture_file(photo, Path(folder), number)
            local, tied = prior.shifted(-origin), known.get(photo.request.photo)
            queries.append(
                Query(
                    name,
                    "",
                    photo.pinhole,
                    local,
                    photo.mask,
                    image,
                    sequence="flight",
                    reconstructed=tied,
                    lens_percent=photo.lens_percent,
                    camera_sigmas=photo.camera_sigmas,
                    measured=photo.measured,
                )
            )
        streams = [partial(random_stream, request.seed, "localize", "photo") for _ in queries]
        return solved_flight(method, queries, city_map, streams, request.out)


def solved_flight(
    method: SupportsFlights,
    queries: Sequence[Query],
    city_map: CityMap,
    streams: Sequence[Streams],
    out: Path,
) -> FlightEstimate:
    """Returns a method's answers to the photos of a flight, in the city's coordinates.

    What a plug-in's code raises is the fault of each of them; where it raised is kept in the folder ``out``.
    """
    origin = city_map.scene.origin
    try:
        with told_as_fault(f"method {getattr(method, 'name', '')}", out, "flight"):
            found = localize_flight(method, queries, city_map, streams)
    except QueryFault as fault:
        return FlightEstimate([fault] * len(queries))

    def placed(each: Estimate) -> Estimate:
        others = tuple(pose.shifted(origin) for pose in each.alternatives)
        return replace(each, pose=each.pose.shifted(origin), alternatives=others)

    answers = [each if isinstance(each, QueryFault) else placed(each) for each in found.estimates]
    return FlightEstimate(answers, found.findings)


def _taken(flight: Flight, names: Sequence[str]) -> list[str]:
    """Returns with what and when a flight was taken, and whose clock is odd."""
    when = "no time stated"
    if flight.started is not None and flight.ended is not None:
        when = f"{flight.started:%Y-%m-%d %H:%M:%S} to {flight.ended:%H:%M:%S}"
    first, last = names[flight.rows[0]], names[flight.rows[-1]]
    lines = [f"{count_of(len(flight.rows), 'photos')}, {first} to {last}, {flight.camera}, {when}"]
    if flight.odd_clocks:
        odd = [names[row] for row in flight.odd_clocks]
        listed = ", ".join(odd[:3]) + (", ..." if len(odd) > 3 else "")
        lines.append(f"the clock jumps at photos that are placed by name: {listed}")
    return lines


def _flight_of(photo: Path, flights: Sequence[FlightAnswer]) -> str:
    return next((flight.name for flight in flights if photo in flight.photos), "")


def _write_findings(answers: Answers, scene: Scene, frame: MapFrame | None) -> None:
    left_out = [
        {"photo": str(each.photo), "reason": each.failure} for each in answers.photos if each.found is None
    ]
    values = {"flights": [flight.to_json() for flight in answers.flights], "left_out": left_out}
    text = json.dumps(finite(values), indent=1, ensure_ascii=False, allow_nan=False)
    write_text(numbered(answers.folder / FLIGHTS_FILE, answers.number), text + "\n")
    if frame is not None:
        features = [
            feature
            for flight in answers.flights
            for feature in contradiction_features(scene, frame, flight.findings, flight.name)
        ]
        write_geojson(features, numbered(answers.folder / FINDINGS_FILE, answers.number))


def page_of_photos(
    flight: FlightAnswer,
    names: Mapping[Path, str],
    answers: Sequence[PhotoAnswer],
    scene: Scene,
    view: str = "",
    imagery: Underlay | None = None,
) -> str:
    """Returns the page of a flight whose photos `lodbench localize` found.

    Args:
        flight: The flight.
        names: Of all photos, by file.
        answers: Of all photos.
        scene: The map.
        view: Address of all photos in three dimensions from this page; "" for none.
        imagery: What lies under the map.
    """
    mine = [answer for answer in answers if answer.flight == flight.name]
    placed = {names[answer.photo]: (answer, answer.found) for answer in mine if answer.found is not None}
    photos = [
        photo_on_page(
            key,
            (found.prior, found.pose, None),
            found.covariance,
            found.probability,
            found.score,
            answer.trust,
            answer.row(),
            reasons_for_doubt(
                answer.trust,
                found.pose,
                found.method_notes,
                None if found.covariance is None else np.diag(found.covariance),
                found.alternatives,
                found.alternative_probabilities,
            ),
        )
        for key, (answer, found) in placed.items()
    ]
    pictures = []
    for key in chosen_for_pictures(list(placed)):
        answer, found = placed[key]
        drawn = read_picture(found.overlay)
        if drawn is not None:
            caption = _caption(key, answer.trust, found.moved)
            pictures.append(Picture(jpeg_bytes(drawn), "jpeg", caption, "", key))
    # Photos that are on no flight are on every flight's page: nobody knows which they belong to.
    left_out = [(names[each.photo], each.failure) for each in answers if each.found is None]
    title = f"{flight.name[0].upper()}{flight.name[1:]}: {count_of(len(photos), 'photos')}"
    return flight_page(
        title,
        flight.taken,
        flight.findings,
        photos,
        pictures,
        left_out,
        *city_and_marks(scene, flight.findings),
        view,
        imagery,
        flight.source,
    )


def _caption(key: str, trust: str, moved: PoseError) -> str:
    return f"{key}: moved {moved.translation_m:.2f} m, turned {moved.rotation_deg:.2f} deg; {trust}"
