"""Whether the poses of a stored run, and what its method said of them, are those that its ledger has."""

from __future__ import annotations

import math

from lodbench.evaluation.errors import pose_error
from lodbench.evaluation.predictions import Prediction
from lodbench.geometry import Pose
from lodbench.harness.runs.predict import PREDICTIONS_FILE, open_predictions
from lodbench.harness.runs.stored import StoredRun

# A pose read back from text is off by rounding: 1e-9 m at coordinates of 5,000 km. A number that
# matters to anybody is 1000 times coarser than this.
TOLERANCE_M, TOLERANCE_DEG = 1e-6, 1e-6
# What a method says of an answer, which is written with all its digits.
_SAID = ("score", "hypotheses", "probability")


def is_without_ledger(stored: StoredRun) -> bool:
    """Tells whether nothing is left of what the method said, which every run but of a pose file stores."""
    ledger = open_predictions(stored.folder, read_only=True)
    return "poses" not in stored.summary["dataset"] and not len(ledger) and not ledger.damaged


def changed_answers(stored: StoredRun) -> list[str]:
    """Returns a line for each answer that is damaged, missing, or another than in ``poses.txt`` and rows.

    A run without a ledger has none, which ``is_without_ledger`` tells: poses may have been made elsewhere.

    Raises:
        DatasetError: A line of the ledger is whole and holds no answer.
    """
    ledger = open_predictions(stored.folder, read_only=True)
    if not len(ledger) and not ledger.damaged:
        return []
    lines = [f"{PREDICTIONS_FILE}: {ledger.damaged} damaged lines"] if ledger.damaged else []
    for key, said in zip(stored.queries.index, stored.queries.to_dict("records"), strict=True):
        if key not in ledger:
            lines.append(f"{PREDICTIONS_FILE}: {key} is missing")
            continue
        answer = Prediction.from_json(ledger[key], f"{stored.folder / PREDICTIONS_FILE}: {key}")
        if not _is_same(answer.pose, stored.poses.get(key)):
            lines.append(f"{PREDICTIONS_FILE}: {key} has another pose than poses.txt")
        lines += [
            f"{PREDICTIONS_FILE}: {key} has another {name} than queries.csv"
            for name in _SAID
            if _is_told(stored, name) and not _is_equal(said[name], getattr(answer, name))
        ]
    return lines


def _is_told(stored: StoredRun, name: str) -> bool:
    """Tells whether any row has a number: rows of older versions do not have them all."""
    return bool(stored.queries[name].notna().any())


def _is_equal(told: float, stored: float | None) -> bool:
    return math.isnan(told) if stored is None else told == stored


def _is_same(one: Pose | None, other: Pose | None) -> bool:
    if one is None or other is None:
        return one is other
    error = pose_error(one, other)
    return error.translation_m <= TOLERANCE_M and error.rotation_deg <= TOLERANCE_DEG
