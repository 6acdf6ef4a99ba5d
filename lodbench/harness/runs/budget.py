"""What accuracy costs: recall of stored runs over the poses that they drew."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from lodbench.evaluation.recall import DEFAULT_THRESHOLDS
from lodbench.harness.runs.stored import StoredRun
from lodbench.reporting.calibration_figures import BudgetPoint

_LABEL = DEFAULT_THRESHOLDS[0].label
Curves = dict[str, list[BudgetPoint]]


def budget_panels(runs: Sequence[StoredRun]) -> dict[str, Curves]:
    """Returns points by panel and by method: a panel for each split of a dataset, tilt and number of queries.

    Runs of a method are one line, fewest poses first; but those whose settings in words differ
    (``features=hog``, ``features=xfeat``) are lines of their own, named so.

    Args:
        runs: Finished, with a truth.
    """
    worded = _differing_words(runs)
    panels: dict[str, Curves] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        summary = run.summary
        method = summary["method"]
        words = {key: value for key, value in method["params"].items() if key in worded[method["name"]]}
        name = " ".join([method["name"], *map(str, words.values())])
        for split, numbers in summary["splits"].items():
            if _LABEL not in numbers.get("recall", {}):
                continue
            point = BudgetPoint(
                float(numbers["hypotheses_per_query"] or 0.0),
                float(numbers["recall"][_LABEL]),
                *map(float, numbers["recall_interval_95"][_LABEL]),
            )
            tilt, count = summary["protocol"]["tilt"], numbers["num_queries"]
            title = f"{summary['dataset']['name']}, {split}, tilt={tilt}, {count} queries"
            panels[title][name].append(point)
    return {
        title: {name: sorted(points) for name, points in curves.items()} for title, curves in panels.items()
    }


def _differing_words(runs: Sequence[StoredRun]) -> dict[str, set[str]]:
    """Returns by method the settings that are words, or none, and that its runs do not agree on."""
    values: dict[str, dict[str, set[Any]]] = defaultdict(lambda: defaultdict(set))
    for run in runs:
        method = run.summary["method"]
        for key, value in method["params"].items():
            if value is None or isinstance(value, str):
                values[method["name"]][key].add(value)
    return {
        name: {key for key, found in by_key.items() if len(found) > 1} for name, by_key in values.items()
    } | {run.summary["method"]["name"]: set() for run in runs if run.summary["method"]["name"] not in values}
