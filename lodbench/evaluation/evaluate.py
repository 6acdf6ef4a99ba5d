"""Predictions against the truth: the one place where errors are made, wherever the predictions come from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lodbench.datasets.query import Entry
from lodbench.evaluation.errors import FAILED, FAILED_PARTS, PoseError, error_parts, pose_error
from lodbench.evaluation.predictions import Prediction
from lodbench.evaluation.rows import NO_TRUTH, QueryRow, is_without_truth
from lodbench.geometry import Pose
from lodbench.rendering import Scorer


def evaluate(
    entries: Sequence[Entry],
    predictions: Mapping[str, Prediction],
    truth: Mapping[str, Pose],
    priors: Mapping[str, Pose | None],
    scorer: Scorer | None = None,
) -> tuple[QueryRow, ...]:
    """Returns one row per query; poses are in the dataset's frame.

    Args:
        entries: The queries.
        predictions: By ``Entry.key``, one for every query.
        truth: True poses by key; a query without one is in no denominator.
        priors: Where the method started, by key.
        scorer: Renders the city, for the IoU of the masks with its silhouette at the truth; None leaves
            it out.
    """
    return tuple(
        _row(entry, predictions[entry.key], truth.get(entry.key), priors.get(entry.key), scorer)
        for entry in entries
    )


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
) -> QueryRow:
    pose = prediction.pose
    known = truth is not None
    return QueryRow(
        name=entry.name,
        split=entry.split,
        pose=pose,
        score=prediction.score,
        hypotheses=prediction.hypotheses,
        failure=_reason(prediction.failure, known),
        error=_error(pose, truth),
        prior_error=_error(prior, truth),
        seconds=prediction.seconds,
        parts=None if truth is None else FAILED_PARTS if pose is None else error_parts(pose, truth),
        mask_iou=mask_iou_at_truth(entry, prediction, truth, scorer),
        probability=prediction.probability,
        covariance=prediction.covariance,
    )


def _error(pose: Pose | None, truth: Pose | None) -> PoseError | None:
    if truth is None:
        return None
    return FAILED if pose is None else pose_error(pose, truth)


def _reason(failure: str, has_truth: bool) -> str:
    """Returns a row's reason: that there is no truth goes before why there is no estimate."""
    if has_truth or is_without_truth(failure):
        return failure
    return f"{NO_TRUTH}; {failure}" if failure else NO_TRUTH
