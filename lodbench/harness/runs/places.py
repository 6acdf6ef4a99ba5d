"""Where a run's cameras are: on maps, in three dimensions, as a surveyor's table; pages of its flights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.pose_text import read_json
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError, LodbenchError
from lodbench.evaluation.metrics import ERROR, PRIOR_ERROR, own_failure
from lodbench.geometry import Pose
from lodbench.harness.city import FURTHEST_M, city_of_dataset, distance_outside_m
from lodbench.harness.photo.outputs import city_and_marks
from lodbench.harness.runs.gallery import picture_of
from lodbench.harness.runs.queries import FLIGHTS_FOLDER, flight_name, prior_of
from lodbench.harness.runs.stored import StoredRun
from lodbench.harness.runs.verify import Verdict
from lodbench.photos.map_frame import SURVEY_COLUMNS, MapFrame, survey_row
from lodbench.photos.pictures import read_picture
from lodbench.rendering import make_renderer
from lodbench.reporting import flight_words, maps
from lodbench.reporting.aligned_text import count_of
from lodbench.reporting.answers import percent_text, rounded_down, trust_label, why_of
from lodbench.storage import hide_formula

if TYPE_CHECKING:
    import pandas as pd
_COLUMNS = ("photo", "split", *SURVEY_COLUMNS, "probability", "trust", "crs", "failure")
Floats = NDArray[np.float64]
# Keys of version 0.1 for changes of the map; its key of whether photos determine a constant is ``told``.
_KINDS_OF_0_1 = {"gone": "demolished", "missing": "unmapped"}


def scene_of(verdict: Verdict) -> Scene | None:
    """Returns the city of a verified run, or None where it is not there."""
    return None if verdict.dataset is None else city_of(verdict.dataset)


def city_of(dataset: Dataset) -> Scene | None:
    """Returns the city of a dataset, or None where it is not there."""
    try:
        return city_of_dataset(dataset).scene
    except LodbenchError:
        return None


def draw_places(
    verdict: Verdict, scene: Scene | None, tilt: str, view: str, imagery: maps.Underlay | None = None
) -> str:
    """Returns the map of a run's page as HTML; "" where the dataset is not there."""
    dataset = verdict.dataset
    if dataset is None:
        return ""

    def place(pose: Pose | None) -> NDArray[np.float64] | None:
        return None if pose is None else pose.center[:2]

    spots = []
    for entry in verdict.entries:
        prior, estimate, truth = map(place, _poses(verdict, entry, tilt, scene))
        answer = verdict.stored.predictions.get(entry.key)
        spots.append(
            maps.Spot(entry.key, prior, estimate, truth, "-" if answer is None else trust_label(answer))
        )
    if scene is None:
        return maps.draw_map(spots, None, None)
    return maps.draw_map(spots, scene.vertices + scene.origin, scene.triangles, view=view, imagery=imagery)


def view_of_run(
    verdict: Verdict, scene: Scene, tilt: str, title: str, pages: Mapping[str, str] | None = None
) -> str:
    """Returns a run in three dimensions: one HTML file of city, cameras and photos; "" without a camera."""
    cameras = []
    for number, entry in enumerate(verdict.entries):
        prior, estimate, truth = (
            None if pose is None else pose.shifted(-scene.origin)
            for pose in _poses(verdict, entry, tilt, scene)
        )
        photo = read_picture(entry.image) if number < maps.MAX_PHOTOS and entry.image is not None else None
        jpeg = None if photo is None else maps.photo_jpeg(photo)
        facts = _facts(verdict, entry.key)
        cameras.append(maps.ViewedCamera(entry.key, facts, entry.camera, prior, estimate, truth, jpeg))
    return maps.draw_view3d(title, scene, cameras, pages)


def _poses(
    verdict: Verdict, entry: Entry, tilt: str, scene: Scene | None
) -> tuple[Pose | None, Pose | None, Pose | None]:
    """Returns prior, estimate and truth of a query, in the dataset's coordinates.

    An unanswered query's prior kilometres outside the city is left out: all else would shrink to a dot.
    """
    assert verdict.dataset is not None  # noqa: S101 - there are entries
    prior, estimate = prior_of(entry, verdict.dataset, tilt), verdict.stored.poses.get(entry.key)
    is_lost = estimate is None and prior is not None and scene is not None
    if is_lost and distance_outside_m(prior, scene) > FURTHEST_M:  # type: ignore[arg-type]
        prior = None
    return prior, estimate, verdict.dataset.truth.get(entry.key)


def _facts(verdict: Verdict, key: str) -> dict[str, str]:
    answer = verdict.stored.predictions.get(key)
    if key not in verdict.stored.queries.index:
        return {}
    row: pd.Series[Any] = verdict.stored.queries.loc[key]  # type: ignore[assignment]
    facts = {"error": _error(row, ERROR), "prior": _error(row, PRIOR_ERROR)}
    if answer is not None:
        facts |= {
            "score": "" if answer.score is None else f"{answer.score:.3f}",
            "trust": trust_label(answer),
        }
        if answer.probability is not None:
            facts["sure"] = percent_text(answer.probability)
        facts["why"] = "; ".join(why_of(answer))
    return {**facts, "failure": own_failure(str(row["failure"]))}


def _error(row: pd.Series[Any], columns: tuple[str, ...]) -> str:
    metres, degrees = (float(row[name]) for name in columns)
    return f"{metres:.2f} m, {degrees:.2f} deg" if math.isfinite(metres) else ""


def survey_table(run: StoredRun, crs: str | None) -> pd.DataFrame:
    """Returns a row per query, by ``split/query``: ``photo``, ``split``, ``SURVEY_COLUMNS`` and more.

    Args:
        run: The run.
        crs: Reference system of its poses; None, or one that is none of a map, leaves latitude and longitude
            empty, and headings count from the y axis.

    ``probability`` is that of being within 2 m and 2 degrees, ``trust`` a word for it, ``failure`` why there
    is no pose.
    """
    import pandas as pd

    frame = None
    with suppress(LodbenchError):
        frame = None if crs is None else MapFrame(crs)
    rows = []
    for key, query in run.queries.iterrows():
        answer, pose = run.predictions[str(key)], run.poses.get(str(key))
        row = dict.fromkeys(_COLUMNS) | {"photo": query["query"], "split": query["split"]}
        if pose is not None:
            row |= survey_row(pose, None if frame is None else frame.place_of(pose), answer.covariance)
        probability = None if answer.probability is None else rounded_down(answer.probability, 4)
        row |= {"probability": probability, "trust": trust_label(answer), "crs": crs}
        rows.append(row | {"failure": own_failure(query["failure"])})
    numbers = dict.fromkeys((*SURVEY_COLUMNS, "probability"), float)
    return pd.DataFrame(rows, index=run.queries.index, columns=list(_COLUMNS)).astype(numbers)


def survey_csv(run: StoredRun, crs: str | None) -> str:
    """Returns ``survey_table`` as CSV; no text is a formula to a spreadsheet."""
    table = survey_table(run, crs)
    for name in ("photo", "split", "failure"):
        table[name] = table[name].map(hide_formula)
    return str(table.to_csv(index=False, lineterminator="\n"))


def pages_of_run(
    verdict: Verdict, scene: Scene, tilt: str, view: str = "", imagery: maps.Underlay | None = None
) -> dict[str, str]:
    """Returns the pages of a run's flights, by the name of the file of what each says."""
    findings = flight_findings(verdict)
    return {
        name: _page_of_sequence(verdict, scene, tilt, name, stated, view, imagery)
        for name, stated in findings.items()
    }


def flight_findings(verdict: Verdict) -> dict[str, dict[str, Any]]:
    """Returns what each flight of a run says, by the name of its file.

    Raises:
        DatasetError: A file is not a JSON object, or says something else.
    """
    findings = {}
    for file in sorted((verdict.stored.folder / FLIGHTS_FOLDER).glob("*.json")):
        stated = findings[file.stem] = read_json(file)
        try:
            for change in stated.get("changes", []):
                change["kind"] = _KINDS_OF_0_1.get(change["kind"], change["kind"])
            for constant in stated.get("constants", {}).values():
                if "told" in constant:
                    constant["determined"] = constant.pop("told")
            flight_words.constants_in_words(stated.get("constants", {})), flight_words.map_in_words(stated)
            len(stated.get("lost", [])), dict(stated.get("reasons", {})), list(stated.get("notes", []))
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            raise DatasetError(
                f"{file} has no constants, buildings and changes as of `method=flight` ({error!r}).",
                "Run the method again.",
            ) from error
    return findings


def _page_of_sequence(
    verdict: Verdict,
    scene: Scene,
    tilt: str,
    name: str,
    findings: Mapping[str, Any],
    view: str,
    imagery: maps.Underlay | None,
) -> str:
    dataset, stored = verdict.dataset, verdict.stored
    assert dataset is not None  # noqa: S101 - the caller has opened it
    entries = [e for e in verdict.entries if flight_name(e) == name]
    photos: list[flight_words.PhotoOnPage] = []
    left_out: list[tuple[str, str]] = []
    surveyed = survey_table(stored, scene.crs).replace({math.nan: None}).to_dict("index")
    for entry in entries:
        answer = stored.predictions.get(entry.key)
        if answer is None or answer.pose is None:
            left_out.append((entry.name, "not asked" if answer is None else answer.failure))
            continue
        poses = prior_of(entry, dataset, tilt), answer.pose, dataset.truth.get(entry.key)
        spread = _full(answer.covariance)
        photos.append(
            flight_words.photo_on_page(
                entry.name,
                poses,
                spread,
                answer.probability,
                answer.score,
                trust_label(answer),
                cast("Mapping[str, float | None]", surveyed[entry.key]),
                why_of(answer),
            )
        )
    chosen = set(flight_words.chosen_for_pictures([photo.spot.key for photo in photos]))
    renderer = make_renderer("silhouette", scene)
    pictures = [
        picture._replace(key=entry.name)
        for entry in entries
        if entry.name in chosen and (picture := picture_of(verdict, renderer, tilt, entry)) is not None
    ]
    lines = [f"{dataset.name} {dataset.version}".strip(), f"run {stored.folder.resolve().name}"]
    return flight_words.flight_page(
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
