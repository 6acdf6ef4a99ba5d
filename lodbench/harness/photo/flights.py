"""Photos of flights over one city: which belong together, solved jointly, what was left out; their pages."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.geojson import write_geojson
from lodbench.datasets.query import Query
from lodbench.errors import LodbenchError, QueryFault
from lodbench.evaluation import PoseError
from lodbench.geometry import Pose
from lodbench.harness.photo import flight_inputs
from lodbench.harness.photo.localize import LocalizedPhoto, inputs_of, open_map, write_answer
from lodbench.harness.photo.many import (
    FINDINGS_FILE,
    FLIGHTS_FILE,
    Answers,
    FlightAnswer,
    PhotoAnswer,
    PhotoWorker,
    PhotoWorkers,
    hint_for_many,
    numbered,
    photo_workers,
    write_answers,
)
from lodbench.harness.photo.outputs import city_and_marks, contradiction_features
from lodbench.harness.photo.prepare import PhotoRequest, PreparedPhoto, prepare_photo
from lodbench.harness.tracebacks import answered_flight, reported_as_fault
from lodbench.methods import Estimate
from lodbench.methods.protocol import FlightEstimate, Streams, SupportsFlights, SupportsPhotosAlone
from lodbench.photos.files import Flight, split_flights
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import height_notes, refused_notes
from lodbench.photos.pictures import read_picture
from lodbench.reporting import aligned_text, flight_words, maps, overlays
from lodbench.reporting.answers import reasons_for_doubt
from lodbench.reporting.page import Picture
from lodbench.storage import random_stream, write_text
from lodbench.storage.json_text import finite

# A photo as it goes from process to process: file, mask, and all that is known of it but the request.
_Sent = tuple[Path, Path | None, dict[str, Any]]


def localize_flights(
    request: PhotoRequest,
    photos: Sequence[Path],
    masks: Path | None,
    reconstruction: Path | None = None,
    imagery: maps.Underlay | None = None,
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
    known = flight_inputs.poses_in_model(reconstruction, photos)
    place = open_map(request)
    names = flight_inputs.names_of(photos)
    own_masks, failures = flight_inputs.masks_of(photos, masks)
    city_map = CityMap(place.scene)
    flights: list[FlightAnswer] = []
    estimates: dict[int, Estimate] = {}
    with photo_workers(request, place) as workers, TemporaryDirectory() as folder:
        items = {
            row: (photo, own_masks[row], Path(folder) / f"{row}.jpg")
            for row, photo in enumerate(photos)
            if row not in failures
        }
        ready, unfit = _ready(request, photos, items, workers)
        failures |= {row: reason for row, (reason, _) in unfit.items()}
        hints = {row: hint for row, (_, hint) in unfit.items()}
        rows = list(ready)
        for flight in split_flights([(photos[row], ready[row].photo.stated) for row in rows]):
            mine = [rows[row] for row in flight.rows]
            solution = _solve(request, {row: ready[row] for row in mine}, photos, known, city_map, workers)
            for row, estimate in zip(mine, solution.estimates, strict=True):
                if isinstance(estimate, QueryFault):
                    failures[row] = estimate.message
                else:
                    estimates[row] = estimate
            taken = _taken(flight, [names[row] for row in rows])
            taken += flight_inputs.tied_notes(reconstruction, [photos[row] for row in mine], known)
            taken += refused_notes([ready[row].photo.stated for row in mine])
            if not request.has_height:
                taken += height_notes([ready[row].photo.stated for row in mine], request.heights)
            name, paths = f"flight {len(flights) + 1}", tuple(photos[row] for row in mine)
            source: flight_words.PriorSource = "metadata" if request.start is None else "poses"
            flights.append(FlightAnswer(name, paths, tuple(taken), solution.findings, source))
        sent = {row: (ready[row].sent, ready[row].prior, each) for row, each in sorted(estimates.items())}
        located = dict(workers.each("overlays", _written, sent, photos))
    answers = [
        PhotoAnswer(
            photo, located.get(row), failures.get(row, ""), _flight_of(photo, flights), hints.get(row, "")
        )
        for row, photo in enumerate(photos)
    ]
    written = write_answers(request.out, answers, flights)
    _write_findings(written, place.scene, place.frame)
    for flight_answer in flights:
        page = page_of_photos(
            flight_answer,
            dict(zip(photos, names, strict=True)),
            answers,
            place.scene,
            written.view.name if written.localized else "",
            imagery,
        )
        write_text(written.page(flight_answer), page)
    return written


@dataclass(frozen=True, slots=True, eq=False)
class _Ready:
    """A photo that can be used."""

    photo: PreparedPhoto  # the photo
    prior: Pose  # its rough pose, in the city's coordinates
    image: Path | None  # its pixels as its pinhole sees them; None where they cannot be decoded

    @property
    def sent(self) -> _Sent:
        """Returns the photo without the request, which workers have."""
        request = self.photo.request
        values = {each.name: getattr(self.photo, each.name) for each in fields(PreparedPhoto)}
        return request.photo, request.mask, {name: v for name, v in values.items() if name != "request"}


def _received(request: PhotoRequest, sent: _Sent) -> PreparedPhoto:
    photo, mask, values = sent
    return PreparedPhoto(replace(request, photo=photo, mask=mask), **values)


def _prepared(
    worker: PhotoWorker, item: tuple[Path, Path | None, Path]
) -> tuple[_Sent, Pose, Path | None] | tuple[str, str]:
    """Returns a photo that can be used, or why it cannot, and what would help; its copy goes to a path."""
    photo, mask, copy = item
    try:
        wanted = replace(worker.request, photo=photo, mask=mask)
        assert wanted.method is not None  # noqa: S101 - the caller has chosen
        prepared = flight_inputs.with_small_mask(prepare_photo(wanted, inputs_of(wanted.method)))
        prior = prepared.prior(worker.place().scene, worker.place().frame)
        image = flight_inputs.picture_file(prepared, copy)
    except LodbenchError as fault:
        return fault.message.rstrip("."), hint_for_many(fault)
    return _Ready(prepared, prior, image).sent, prior, image


def _ready(
    request: PhotoRequest,
    photos: Sequence[Path],
    items: Mapping[int, tuple[Path, Path | None, Path]],
    workers: PhotoWorkers,
) -> tuple[dict[int, _Ready], dict[int, tuple[str, str]]]:
    """Returns the photos that can be used, by row, and why others cannot and what would help."""
    ready, failures = dict[int, _Ready](), dict[int, tuple[str, str]]()
    for row, outcome in workers.each("masks", _prepared, items, photos):
        if len(outcome) == 3:
            ready[row] = _Ready(_received(request, outcome[0]), *outcome[1:])
        else:
            failures[row] = outcome
    return dict(sorted(ready.items())), failures


def _solve(
    request: PhotoRequest,
    ready: Mapping[int, _Ready],
    photos: Sequence[Path],
    known: Mapping[Path, Pose],
    city_map: CityMap,
    workers: PhotoWorkers,
) -> FlightEstimate:
    """Returns the answers to the photos of a flight, in the city's coordinates."""
    method, names = request.method, flight_inputs.names_of(photos)
    assert isinstance(method, SupportsFlights)  # noqa: S101 - the caller has looked
    queries = {
        row: Query(
            names[row],
            "",
            each.photo.pinhole,
            each.prior.shifted(-city_map.scene.origin),
            each.photo.mask,
            each.image,
            sequence="flight",
            reconstructed=known.get(photos[row]),
            lens_percent=each.photo.lens_percent,
            camera_sigmas=each.photo.camera_sigmas,
            measured=each.photo.measured,
        )
        for row, each in ready.items()
    }
    streams = partial(random_stream, request.seed, "localize", "photo")
    alone = None
    if isinstance(method, SupportsPhotosAlone) and request.workers > 1:
        items = {row: (query, streams) for row, query in queries.items()}
        by_row = dict(workers.each("photos", _alone, items, photos))
        alone = [by_row[row] for row in queries]
    return solved_flight(method, [*queries.values()], city_map, [streams] * len(queries), request.out, alone)


def _alone(worker: PhotoWorker, item: tuple[Query, Streams]) -> Estimate | QueryFault:
    """Returns what a photo of a flight says by itself."""
    method = worker.request.method
    assert isinstance(method, SupportsPhotosAlone)  # noqa: S101 - the caller has looked
    query, streams = item
    try:
        with reported_as_fault(f"method {getattr(method, 'name', '')}", worker.request.out, query.name):
            (answer,) = method.localize_alone([query], worker.city_map, [streams])
    except QueryFault as fault:
        return fault
    return answer


def _written(worker: PhotoWorker, item: tuple[_Sent, Pose, Estimate]) -> LocalizedPhoto:
    """Writes a photo's answer."""
    sent, prior, estimate = item
    photo = _received(worker.request, sent)
    return write_answer(photo, photo.view(), worker.place(), prior, estimate)


def solved_flight(
    method: SupportsFlights,
    queries: Sequence[Query],
    city_map: CityMap,
    streams: Sequence[Streams],
    out: Path,
    alone: Sequence[Estimate | QueryFault] | None = None,
) -> FlightEstimate:
    """Returns a method's answers to the photos of a flight, in the city's coordinates.

    What a plug-in's code raises is the fault of each of them; where it raised is kept in the folder ``out``.
    ``alone`` is what each photo says by itself, where that is known.
    """
    origin, part = city_map.scene.origin, f"method {getattr(method, 'name', '')}"
    solution = answered_flight(method, queries, city_map, streams, out, "flight", part, alone)

    def placed(each: Estimate) -> Estimate:
        others = tuple(pose.shifted(origin) for pose in each.alternatives)
        return replace(each, pose=each.pose.shifted(origin), alternatives=others)

    answers = [each if isinstance(each, QueryFault) else placed(each) for each in solution.estimates]
    return FlightEstimate(answers, solution.findings)


def _taken(flight: Flight, names: Sequence[str]) -> list[str]:
    """Returns with what and when a flight was taken, and whose clock is odd."""
    when = "no time stated"
    if flight.started is not None and flight.ended is not None:
        when = f"{flight.started:%Y-%m-%d %H:%M:%S} to {flight.ended:%H:%M:%S}"
    first, last = names[flight.rows[0]], names[flight.rows[-1]]
    lines = [
        f"{aligned_text.count_of(len(flight.rows), 'photos')}, {first} to {last}, {flight.camera}, {when}"
    ]
    if flight.odd_clocks:
        odd = [names[row] for row in flight.odd_clocks]
        listed = ", ".join(odd[:3]) + (", ..." if len(odd) > 3 else "")
        lines.append(f"the clock jumps at photos that are placed by name: {listed}")
    return lines


def _flight_of(photo: Path, flights: Sequence[FlightAnswer]) -> str:
    return next((flight.name for flight in flights if photo in flight.photos), "")


def _write_findings(answers: Answers, scene: Scene, frame: MapFrame | None) -> None:
    left_out = [
        {"photo": str(each.photo), "reason": each.failure}
        for each in answers.photos
        if each.localized is None
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
    imagery: maps.Underlay | None = None,
) -> str:
    """Returns the page of a flight whose photos `lodbench localize` found."""
    mine = [answer for answer in answers if answer.flight == flight.name]
    placed = {
        names[answer.photo]: (answer, answer.localized) for answer in mine if answer.localized is not None
    }
    photos = [
        flight_words.photo_on_page(
            key,
            (localized.prior, localized.pose, None),
            localized.covariance,
            localized.probability,
            localized.score,
            answer.trust,
            answer.row(),
            reasons_for_doubt(
                answer.trust,
                localized.pose,
                localized.method_notes,
                None if localized.covariance is None else np.diag(localized.covariance),
                localized.alternatives,
                localized.alternative_probabilities,
            ),
        )
        for key, (answer, localized) in placed.items()
    ]
    pictures = []
    for key in flight_words.chosen_for_pictures(list(placed)):
        answer, localized = placed[key]
        drawn = read_picture(localized.overlay)
        if drawn is not None:
            caption = _caption(key, answer.trust, localized.moved)
            pictures.append(Picture(overlays.jpeg_bytes(drawn), "jpeg", caption, "", key))
    # Photos that are on no flight are on every flight's page: nobody knows which they belong to.
    left_out = [(names[each.photo], each.failure) for each in answers if each.localized is None]
    title = f"{flight.name[0].upper()}{flight.name[1:]}: {aligned_text.count_of(len(photos), 'photos')}"
    return flight_words.flight_page(
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
