"""Whether two stored runs differ: tests over the queries that both were scored on."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lodbench.evaluation.errors import Apart, apart, pose_error
from lodbench.evaluation.predictions import Prediction
from lodbench.evaluation.queries import ERROR, has_truth, of_split
from lodbench.evaluation.recall import PROBABILITY_THRESHOLD, Threshold, hits_of
from lodbench.evaluation.statistics import Agreement, Comparison, mcnemar, paired_medians
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


def require_same_queries(first: StoredRun, second: StoredRun) -> str:
    """Returns why two runs cannot be compared query by query; "" if they can."""
    if first.summary["dataset"]["name"] != second.summary["dataset"]["name"]:
        return "the datasets differ"
    keys = [set(run.queries.index[has_truth(run.queries)]) for run in (first, second)]
    if not any(keys):
        return "there is no truth to compare with"
    if keys[0] != keys[1]:
        return f"the queries differ: {len(keys[0] ^ keys[1])} are in one run only"
    truths = [run.summary["dataset"].get("queries") for run in (first, second)]
    if truths[0] != truths[1]:
        return "the names are the same, but not the cameras, priors or truths"
    photos = {run.summary["dataset"].get("images") for run in (first, second)}
    if len(photos - {None}) > 1:
        return "the photos differ"
    return ""


def paired_comparison(
    first: StoredRun, second: StoredRun, thresholds: Sequence[Threshold]
) -> list[Comparison]:
    """Returns the tests of each split: recall at each threshold, and the median errors.

    Args:
        first: A run.
        second: Another over the same queries (see ``require_same_queries``).
        thresholds: Where to compare recall.
    """
    found = []
    for split in first.summary["splits"]:
        scored = of_split(first.queries, split)
        if scored.empty:
            continue  # no truth to be tested against
        errors = list(ERROR)
        a, b = scored[errors].to_numpy(), second.queries.loc[scored.index, errors].to_numpy()
        for threshold in thresholds:
            hits = hits_of(a, threshold), hits_of(b, threshold)
            before, after = (100.0 * float(hit.mean()) for hit in hits)
            found.append(Comparison(split, f"recall {threshold.label}", "%", before, after, mcnemar(*hits)))
        for column, (name, unit) in enumerate((("median translation", "m"), ("median rotation", "deg"))):
            x, y = a[:, column], b[:, column]
            medians = float(np.median(x)), float(np.median(y))
            found.append(Comparison(split, name, unit, *medians, paired_medians(x, y)))
    return found


def why_other_photos(first: StoredRun, second: StoredRun) -> str:
    """Returns why the photos of two runs are not the same; "" if they are, whatever their priors and maps.

    Queries of two datasets, or of two versions of one, are not the same, whatever their names; nor are those
    whose answers are further apart than both are from the truth together: it is not one truth. Where nobody
    knows the truth, other photos of the same names are other places.
    """
    datasets = [[run.summary["dataset"][name] for name in ("name", "version")] for run in (first, second)]
    if datasets[0] != datasets[1]:
        return "the datasets differ"
    is_scored = any(has_truth(run.queries).any() for run in (first, second))
    photos = {run.summary["dataset"].get("images") for run in (first, second)}
    if not is_scored and len(photos - {None}) > 1:
        return "the photos differ"
    found = answers_apart(first, second)
    reach = sum(run.queries.loc[list(found), list(ERROR)].to_numpy() for run in (first, second))
    errors = np.array([each.error for each in found.values()]).reshape(-1, 2)
    if (errors > reach + TOLERANCE_M).any():  # never where a truth, NaN, is not known
        return "the names are the same, but not the true poses"
    return ""


def answers_apart(first: StoredRun, second: StoredRun) -> dict[str, Apart]:
    """Returns how far the answers of two runs lie apart, by ``split/query``, where both answered."""
    shared = [key for key in first.poses if key in second.poses]
    return {key: apart(second.poses[key], first.poses[key]) for key in shared}


def agreement(first: StoredRun, second: StoredRun) -> Agreement | None:
    """Returns how far the answers of two runs lie apart; None where no photo has an answer of both."""
    if why_other_photos(first, second):
        return None
    found = answers_apart(first, second).values()
    if not found:
        return None
    errors = np.array([each.error for each in found])
    parts = np.abs([[each.parts.horizontal_m, each.parts.vertical_m] for each in found])
    within = int(hits_of(errors, PROBABILITY_THRESHOLD).sum())
    medians = [*np.median(errors, axis=0), *np.median(parts, axis=0)]
    return Agreement(len(found), within, *map(float, medians))
