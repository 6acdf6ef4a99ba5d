"""Where a run's cameras are: on the map of its page, and in three dimensions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import LodbenchError
from lodbench.evaluation.queries import ERROR, PRIOR_ERROR, own_failure
from lodbench.geometry import Pose
from lodbench.harness.city import FURTHEST_M, distance_outside_m, open_city
from lodbench.harness.runs.prepare import prior_of
from lodbench.harness.runs.verify import Verdict
from lodbench.photos.pictures import read_picture
from lodbench.reporting.answers import percent_text, trust_of
from lodbench.reporting.doubts import why_of
from lodbench.reporting.map_figure import Spot, Underlay, draw_map
from lodbench.reporting.view3d import MAX_PHOTOS, ViewedCamera, draw_view3d, photo_jpeg

if TYPE_CHECKING:
    import pandas as pd


def scene_of(verdict: Verdict) -> Scene | None:
    """Returns the city of a verified run, or None where it is not there."""
    return None if verdict.dataset is None else city_of(verdict.dataset)


def city_of(dataset: Dataset) -> Scene | None:
    """Returns the city of a dataset, or None where it is not there."""
    if dataset.city_model is None:
        return None
    try:
        return open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height).scene
    except LodbenchError:
        return None


def draw_places(
    verdict: Verdict, scene: Scene | None, tilt: str, view: str, imagery: Underlay | None = None
) -> str:
    """Returns the map of a run's page as HTML; "" where the dataset is not there.

    Args:
        verdict: The run.
        scene: Its city, or None.
        tilt: Which prior it had.
        view: File of the view in three dimensions that the map leads to; "" for none.
        imagery: What lies under the map.
    """
    dataset = verdict.dataset
    if dataset is None:
        return ""

    def place(pose: Pose | None) -> NDArray[np.float64] | None:
        return None if pose is None else pose.center[:2]

    spots = []
    for entry in verdict.entries:
        prior, estimate, truth = map(place, _poses(verdict, entry, tilt, scene))
        found = verdict.stored.predictions.get(entry.key)
        spots.append(Spot(entry.key, prior, estimate, truth, "-" if found is None else trust_of(found)))
    if scene is None:
        return draw_map(spots, None, None)
    return draw_map(spots, scene.vertices + scene.origin, scene.triangles, view=view, imagery=imagery)


def view_of_run(
    verdict: Verdict, scene: Scene, tilt: str, title: str, pages: Mapping[str, str] | None = None
) -> str:
    """Returns a run in three dimensions: one HTML file of city, cameras and photos; "" without a camera.

    Args:
        verdict: The run.
        scene: Its city.
        tilt: Which prior it had.
        title: Of the page.
        pages: Addresses of the pages that it leads to, by what they are called.
    """
    cameras = []
    for number, entry in enumerate(verdict.entries):
        prior, estimate, truth = (
            None if pose is None else pose.shifted(-scene.origin)
            for pose in _poses(verdict, entry, tilt, scene)
        )
        photo = read_picture(entry.image) if number < MAX_PHOTOS and entry.image is not None else None
        jpeg = None if photo is None else photo_jpeg(photo)
        facts = _facts(verdict, entry.key)
        cameras.append(ViewedCamera(entry.key, facts, entry.camera, prior, estimate, truth, jpeg))
    return draw_view3d(title, scene, cameras, pages)


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
    """Returns what is told of a query, by name."""
    found = verdict.stored.predictions.get(key)
    if key not in verdict.stored.queries.index:
        return {}
    row: pd.Series[Any] = verdict.stored.queries.loc[key]  # type: ignore[assignment]
    facts = {"error": _error(row, ERROR), "prior": _error(row, PRIOR_ERROR)}
    if found is not None:
        facts |= {"score": "" if found.score is None else f"{found.score:.3f}", "trust": trust_of(found)}
        if found.probability is not None:
            facts["sure"] = percent_text(found.probability)
        facts["why"] = "; ".join(why_of(found))
    return {**facts, "failure": own_failure(str(row["failure"]))}


def _error(row: pd.Series[Any], columns: tuple[str, ...]) -> str:
    metres, degrees = (float(row[name]) for name in columns)
    return f"{metres:.2f} m, {degrees:.2f} deg" if math.isfinite(metres) else ""
