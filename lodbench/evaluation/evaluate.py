"""Predictions against the truth: the one place where errors are made, wherever the predictions come from."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lodbench.citymap.surfaces import Surfaces
from lodbench.datasets.query import Entry
from lodbench.evaluation.errors import FAILED, FAILED_PARTS, error_parts, pose_error
from lodbench.evaluation.predictions import Prediction
from lodbench.evaluation.protocols import EAST_NORTH, GROUND
from lodbench.evaluation.queries import ERROR, NO_TRUTH, PARTS, PRIOR_ERROR, is_without_truth, queries_frame
from lodbench.geometry import Pose
from lodbench.rendering import Scorer

if TYPE_CHECKING:
    import pandas as pd


def evaluate(
    entries: Sequence[Entry],
    predictions: Mapping[str, Prediction],
    truth: Mapping[str, Pose],
    priors: Mapping[str, Pose | None],
    scorer: Scorer | None = None,
    tilt: str = "prior",
    columns: Collection[str] = (),
) -> pd.DataFrame:
    """Returns the table of queries (``lodbench.evaluation.queries``); poses are in the dataset's frame.

    Args:
        entries: The queries.
        predictions: By ``Entry.key``, one for every query.
        truth: True poses by key; a query without one is in no denominator.
        priors: Where the method started, by key.
        scorer: Renders the city, for the IoU of the masks with its silhouette at the truth; None leaves
            it out.
        tilt: ``prior`` or ``truth``: what the priors have, to be written down.
        columns: Further errors, of ``lodbench.evaluation.protocols``.
    """
    rows = [
        _row(entry, predictions[entry.key], truth.get(entry.key), priors.get(entry.key), scorer)
        for entry in entries
    ]
    surfaces = None if scorer is None or GROUND not in columns else Surfaces(scorer.scene)
    for row, entry in zip(rows, entries, strict=True):
        errors = _more_errors(entry, predictions[entry.key].pose, truth.get(entry.key), surfaces)
        row |= {"tilt": tilt, **{name: errors[name] for name in columns}}
    return queries_frame(rows)


def _more_errors(
    entry: Entry, pose: Pose | None, truth: Pose | None, surfaces: Surfaces | None
) -> dict[str, float]:
    """Returns the camera's errors east and north, and the distance in plan of what the photo's centre shows.

    NaN without a truth, or where the centre shows no ground; inf without an answer.
    """
    if truth is None or pose is None:
        return dict.fromkeys((*EAST_NORTH, GROUND), math.nan if truth is None else math.inf)
    east, north, _ = map(float, pose.center - truth.center)
    ground = math.nan
    if surfaces is not None and entry.camera is not None:
        camera = entry.camera
        middle = np.array([0.5 * camera.width - camera.cx, 0.5 * camera.height - camera.cy])
        ray = np.array([middle[0] / camera.fx, middle[1] / camera.fy, 1.0])
        places = [
            surfaces.hit(each.center - surfaces.scene.origin, (ray @ each.rotation)[None]).places[0, :2]
            for each in (truth, pose)
        ]
        away = float(np.hypot(*(places[1] - places[0])))
        # An estimate that looks past the ground is wrong without bounds.
        ground = math.inf if math.isnan(away) and not np.isnan(places[0]).any() else away
    return dict(zip((*EAST_NORTH, GROUND), (east, north, ground), strict=True))


def mask_iou_at_truth(
    entry: Entry, prediction: Prediction, truth: Pose | None, scorer: Scorer | None
) -> float | None:
    """Returns the IoU of a stored mask with the model's silhouette at the truth (paper, Table 4); or None."""
    mask = prediction.mask
    if mask is None or truth is None or scorer is None or entry.camera is None:
        return None
    height, width = mask.shape
    pose = truth.shifted(-scorer.scene.origin)
    counts = scorer.counts(entry.camera.scaled(width, height), pose.rotation[None], pose.center[None], mask)
    return float(counts.iou()[0])


def _row(
    entry: Entry, prediction: Prediction, truth: Pose | None, prior: Pose | None, scorer: Scorer | None
) -> dict[str, Any]:
    pose = prediction.pose
    row: dict[str, Any] = {
        "query": entry.name,
        "split": entry.split,
        "score": prediction.score,
        "hypotheses": prediction.hypotheses,
        "failure": _reason(prediction.failure, truth is not None),
        "mask_iou": mask_iou_at_truth(entry, prediction, truth, scorer),
        "probability": prediction.probability,
        "covariance": " ".join(map(repr, prediction.covariance)),
    }
    if truth is not None:
        row |= zip(ERROR, FAILED if pose is None else pose_error(pose, truth), strict=True)
        row |= zip(PRIOR_ERROR, FAILED if prior is None else pose_error(prior, truth), strict=True)
        row |= zip(PARTS, FAILED_PARTS if pose is None else error_parts(pose, truth), strict=True)
    return row


def _reason(failure: str, has_truth: bool) -> str:
    """Returns a row's reason: that there is no truth goes before why there is no estimate."""
    # A carriage return by itself would end a row of queries.csv for who reads it.
    failure = failure.replace("\r\n", "\n").replace("\r", "\n")
    if has_truth or is_without_truth(failure):
        return failure
    return f"{NO_TRUTH}; {failure}" if failure else NO_TRUTH
