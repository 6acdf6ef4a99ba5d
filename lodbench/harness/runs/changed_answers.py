"""Whether the poses of a stored run are those that its ledger has."""

from __future__ import annotations

from lodbench.evaluation.errors import pose_error
from lodbench.evaluation.predictions import Prediction
from lodbench.geometry import Pose
from lodbench.harness.runs.predict import PREDICTIONS_FILE, open_predictions
from lodbench.harness.runs.stored import StoredRun

# A pose read back from text is off by rounding: 1e-9 m at coordinates of 5,000 km. A number that
# matters to anybody is 1000 times coarser than this.
TOLERANCE_M, TOLERANCE_DEG = 1e-6, 1e-6


def changed_answers(stored: StoredRun) -> list[str]:
    """Returns a line for each answer that is damaged, missing, or another than in ``poses.txt``.

    A run without a ledger has none: poses may have been made elsewhere.

    Raises:
        DatasetError: A line of the ledger is whole and holds no answer.
    """
    ledger = open_predictions(stored.folder, read_only=True)
    if not len(ledger) and not ledger.damaged:
        return []
    lines = [f"{PREDICTIONS_FILE}: {ledger.damaged} damaged lines"] if ledger.damaged else []
    for key in stored.queries.index:
        if key not in ledger:
            lines.append(f"{PREDICTIONS_FILE}: {key} is missing")
            continue
        answer = Prediction.from_json(ledger[key], f"{stored.folder / PREDICTIONS_FILE}: {key}")
        if not _is_same(answer.pose, stored.poses.get(key)):
            lines.append(f"{PREDICTIONS_FILE}: {key} has another pose than poses.txt")
    return lines


def _is_same(one: Pose | None, other: Pose | None) -> bool:
    if one is None or other is None:
        return one is other
    error = pose_error(one, other)
    return error.translation_m <= TOLERANCE_M and error.rotation_deg <= TOLERANCE_DEG
