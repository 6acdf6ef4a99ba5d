"""Pages of a stored run's flights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.posed import read_json
from lodbench.errors import DatasetError
from lodbench.harness.flights.map_findings import city_and_marks
from lodbench.harness.runs.answer import FLIGHTS_FOLDER, flight_name
from lodbench.harness.runs.prepare import prior_of
from lodbench.harness.runs.query_pictures import picture_of
from lodbench.harness.runs.verify import Verdict
from lodbench.rendering import make_renderer
from lodbench.reporting.aligned_text import count_of
from lodbench.reporting.answers import trust_of
from lodbench.reporting.doubts import why_of
from lodbench.reporting.flight_page import PhotoOnPage, chosen_for_pictures, flight_page, photo_on_page
from lodbench.reporting.flight_words import constants_in_words, map_in_words
from lodbench.reporting.map_figure import Underlay

Floats = NDArray[np.float64]


def pages_of_run(
    verdict: Verdict, scene: Scene, tilt: str, view: str = "", imagery: Underlay | None = None
) -> dict[str, str]:
    """Returns the pages of a run's flights, by the name of the file of what each says.

    Args:
        verdict: The run.
        scene: Its city.
        tilt: Which prior it had.
        view: Address of the run in three dimensions from these pages; "" for none.
        imagery: What lies under the maps.
    """
    found = flight_findings(verdict)
    return {
        name: _page_of_sequence(verdict, scene, tilt, name, said, view, imagery)
        for name, said in found.items()
    }


def flight_findings(verdict: Verdict) -> dict[str, dict[str, Any]]:
    """Returns what each flight of a run says, by the name of its file.

    Raises:
        DatasetError: A file is not a JSON object, or says something else.
    """
    found = {}
    for file in sorted((verdict.stored.folder / FLIGHTS_FOLDER).glob("*.json")):
        said = found[file.stem] = read_json(file)
        try:
            constants_in_words(said.get("constants", {})), map_in_words(said)
            len(said.get("lost", [])), dict(said.get("reasons", {})), list(said.get("notes", []))
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            raise DatasetError(
                f"{file} has no constants, buildings and changes as of method=flight ({error!r}).",
                "Run the method again.",
            ) from error
    return found


def _page_of_sequence(
    verdict: Verdict,
    scene: Scene,
    tilt: str,
    name: str,
    findings: Mapping[str, Any],
    view: str,
    imagery: Underlay | None,
) -> str:
    dataset, stored = verdict.dataset, verdict.stored
    assert dataset is not None  # noqa: S101 - the caller has opened it
    entries = [e for e in verdict.entries if flight_name(e) == name]
    photos: list[PhotoOnPage] = []
    left_out: list[tuple[str, str]] = []
    for entry in entries:
        found = stored.predictions.get(entry.key)
        if found is None or found.pose is None:
            left_out.append((entry.name, "not asked" if found is None else found.failure))
            continue
        poses = prior_of(entry, dataset, tilt), found.pose, dataset.truth.get(entry.key)
        spread = _full(found.covariance)
        photos.append(
            photo_on_page(
                entry.name, poses, spread, found.probability, found.score, trust_of(found), why_of(found)
            )
        )
    chosen = set(chosen_for_pictures([photo.spot.key for photo in photos]))
    renderer = make_renderer("silhouette", scene)
    pictures = [
        picture._replace(key=entry.name)
        for entry in entries
        if entry.name in chosen and (picture := picture_of(verdict, renderer, tilt, entry)) is not None
    ]
    lines = [f"{dataset.name} {dataset.version}".strip(), f"run {stored.folder.resolve().name}"]
    return flight_page(
        f"{name}: {count_of(len(photos), 'photos')}",
        lines,
        findings,
        photos,
        pictures,
        left_out,
        *city_and_marks(scene, findings),
        view,
        imagery,
        "poses",
    )


def _full(upper: Sequence[float]) -> Floats | None:
    """Returns the (6, 6) covariance of its upper triangle's 21 numbers; None for none."""
    if not upper:
        return None
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = upper
    return np.asarray(matrix + np.triu(matrix, 1).T)
