"""Predictions against the truth: the one place where errors are made, wherever the predictions come from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lodbench.datasets.query import Entry
from lodbench.evaluation.errors import FAILED, FAILED_PARTS, error_parts, pose_error
from lodbench.evaluation.predictions import Prediction
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
    """
    rows = (
        _row(entry, predictions[entry.key], truth.get(entry.key), priors.get(entry.key), scorer)
        for entry in entries
    )
    return queries_frame({**row, "tilt": tilt} for row in rows)


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
