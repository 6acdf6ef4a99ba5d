"""What a scored set of poses is, wherever the poses came from: a method's run, a file, a stored run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodbench.datasets.query import Dataset, Entry
from lodbench.evaluation.errors import FAILED, FAILED_PARTS, ErrorParts, PoseError, error_parts, pose_error
from lodbench.evaluation.rows import NO_TRUTH, QueryRow
from lodbench.geometry import Pose
from lodbench.harness.runs.prepare import prior_of
from lodbench.storage import digest_of


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """Rows and all that the tables and artefacts say about where they came from.

    Attributes:
        folder: The run folder.
        config: The resolved configuration.
        dataset: The dataset.
        splits: Splits scored, in order.
        rows: One row per query.
        inputs: Digests of what went in.
        lod: Level of detail localised against; None where no city was opened or it has no name.
    """

    folder: Path
    config: dict[str, Any]
    dataset: Dataset
    splits: tuple[str, ...]
    rows: tuple[QueryRow, ...]
    inputs: dict[str, str]
    lod: str | None


def chosen_entries(dataset: Dataset, splits: tuple[str, ...], limit: int | None) -> tuple[Entry, ...]:
    """Returns the entries of some splits, at most ``limit`` of each, in file order by split."""
    by_split = [[entry for entry in dataset.entries if entry.split == split] for split in splits]
    return tuple(entry for entries in by_split for entry in entries[:limit])


def queries_digest(dataset: Dataset, entries: tuple[Entry, ...]) -> str:
    """Returns a digest of the names, cameras, priors and truth of some entries."""
    return digest_of(
        [
            [
                entry.key,
                repr(entry.camera),
                pose_numbers(entry.prior),
                pose_numbers(dataset.truth.get(entry.key)),
            ]
            for entry in entries
        ]
    )


def split_digest(entries: tuple[Entry, ...]) -> str:
    """Returns a digest of which queries are scored, in which splits."""
    return digest_of([entry.key for entry in entries])


def pose_numbers(pose: Pose | None) -> list[float] | None:
    """Returns the twelve numbers of a world-to-camera pose by rows: what digests and the ledger keep."""
    return None if pose is None else [float(v) for v in pose.cam_from_world[:3].ravel()]


def errors_of(
    entry: Entry, pose: Pose | None, dataset: Dataset, tilt: str
) -> tuple[PoseError | None, PoseError | None]:
    """Returns the errors of an estimate and of the prior it had.

    Both are None where there is no truth; a missing pose counts as ``FAILED``. All poses are in the
    dataset's frame.
    """
    truth, prior = dataset.truth.get(entry.key), prior_of(entry, dataset, tilt)
    if truth is None:
        return None, None
    return (
        FAILED if pose is None else pose_error(pose, truth),
        FAILED if prior is None else pose_error(prior, truth),
    )


def parts_of(entry: Entry, pose: Pose | None, dataset: Dataset) -> ErrorParts | None:
    """Returns an estimate's error taken apart; None where there is no truth."""
    truth = dataset.truth.get(entry.key)
    if truth is None:
        return None
    return FAILED_PARTS if pose is None else error_parts(pose, truth)


def is_without_truth(failure: str) -> bool:
    """Tells whether a row's reason is that nothing is known to compare with: it is in no denominator."""
    return failure.startswith(NO_TRUTH)


def failure_of(key: str, failure: str, dataset: Dataset) -> str:
    """Returns a row's reason: that there is no truth goes before why there is no estimate.

    Args:
        key: Of the query.
        failure: Why there is no estimate, or "".
        dataset: Whose truth counts.
    """
    if key in dataset.truth or is_without_truth(failure):
        return failure
    return f"{NO_TRUTH}; {failure}" if failure else NO_TRUTH
