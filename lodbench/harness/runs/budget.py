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
    """Returns points by panel and by method: a panel for each split of a dataset at a tilt.

    Runs of a method are one line, fewest poses first; but those whose settings in words differ
    (``features=hog``, ``features=xfeat``) are lines of their own, named so. Where runs differ in their number
    of queries, names say it.
    """
    worded = _differing_words(runs)
    counted = len({_counts(run) for run in runs}) > 1
    panels: dict[str, Curves] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        summary = run.summary
        method = summary["method"]
        words = [value for key, value in method["params"].items() if key in worded[method["name"]]]
        for split, numbers in summary["splits"].items():
            if _LABEL not in numbers.get("recall", {}):
                continue
            point = BudgetPoint(
                float(numbers["hypotheses_per_query"] or 0.0),
                float(numbers["recall"][_LABEL]),
                *map(float, numbers["recall_interval_95"][_LABEL]),
            )
            count = f"({numbers['num_queries']} queries)" if counted else ""
            name = " ".join(str(word) for word in (method["name"], *words, count) if word)
            title = f"{summary['dataset']['name']}, {split}, tilt={summary['protocol']['tilt']}"
            panels[title][name].append(point)
    return {
        title: {name: sorted(points) for name, points in curves.items()} for title, curves in panels.items()
    }


def _counts(run: StoredRun) -> tuple[int, ...]:
    return tuple(numbers["num_queries"] for numbers in run.summary["splits"].values())


def _differing_words(runs: Sequence[StoredRun]) -> dict[str, set[str]]:
    """Returns by method the settings that are words, or none, and that its runs do not agree on."""
    values: dict[str, dict[str, set[Any]]] = defaultdict(lambda: defaultdict(set))
    for run in runs:
        method = run.summary["method"]
        for key, value in method["params"].items():
            if value is None or isinstance(value, str):
                values[method["name"]][key].add(value)
    return {
        name: {key for key, found in values[name].items() if len(found) > 1}
        for name in {run.summary["method"]["name"] for run in runs}
    }
