"""Whether two stored runs differ: tests over the queries that both were scored on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lodbench.evaluation.errors import Apart, apart
from lodbench.evaluation.queries import ERROR, has_truth, of_split
from lodbench.evaluation.recall import PROBABILITY_THRESHOLD, Threshold, hits_of
from lodbench.evaluation.statistics import Agreement, Comparison, mcnemar, paired_medians
from lodbench.harness.runs.changed_answers import TOLERANCE_M
from lodbench.harness.runs.stored import StoredRun


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
