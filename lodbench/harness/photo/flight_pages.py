"""Pages of the flights whose photos `lodbench localize` found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.evaluation import PoseError
from lodbench.harness.flights.map_findings import city_and_marks
from lodbench.harness.photo.many import FlightAnswer, PhotoAnswer
from lodbench.photos.pictures import read_picture
from lodbench.reporting.aligned_text import count_of
from lodbench.reporting.doubts import reasons_for_doubt
from lodbench.reporting.flight_page import chosen_for_pictures, flight_page, photo_on_page
from lodbench.reporting.map_figure import Underlay
from lodbench.reporting.overlays import jpeg_bytes
from lodbench.reporting.page import Picture


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
