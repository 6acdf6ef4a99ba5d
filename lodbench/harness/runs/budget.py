"""What accuracy costs: recall of stored runs over the poses that they drew."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from lodbench.citymodel.lods import lod_in_words
from lodbench.evaluation.recall import DEFAULT_THRESHOLDS
from lodbench.harness.runs.stored import StoredRun
from lodbench.reporting.aligned_text import count_of
from lodbench.reporting.calibration_figures import BudgetPoint

_LABEL = DEFAULT_THRESHOLDS[0].label
Curves = dict[str, list[BudgetPoint]]


def budget_panels(runs: Sequence[StoredRun]) -> dict[str, Curves]:
    """Returns points by panel and by method: a panel for each split of a dataset at a tilt.

    Runs of a method are one line, fewest poses first; but those whose settings in words differ
    (``features=hog``, ``features=xfeat``), or their segmenter, level of detail, priors or the ``settings`` of
    their data, where summaries have them, are lines of their own, named so. Where runs differ in their number
    of queries, names say it. A split without a truth has no recall, and no point.
    """
    worded = _differing_words(runs)
    versions = {(run.summary["dataset"]["name"], run.summary["dataset"]["version"]) for run in runs}
    counted = len({_counts(run) for run in runs}) > 1
    panels: dict[str, Curves] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        summary = run.summary
        method, dataset = summary["method"]["name"], summary["dataset"]["name"]
        words = [value for key, value in _words(summary).items() if key in worded[method]]
        if len([name for name, _ in versions if name == dataset]) > 1:
            dataset = f"{dataset} ({summary['dataset']['version']})"
        for split, numbers in summary["splits"].items():
            if numbers["recall"].get(_LABEL) is None:
                continue
            count = f"({count_of(numbers['num_queries'], 'queries')})" if counted else ""
            name = " ".join(str(word) for word in (method, *words, count) if word)
            panels[f"{dataset}, {split}, tilt={summary['protocol']['tilt']}"][name].append(_point(numbers))
    return {
        title: {name: sorted(points) for name, points in curves.items()} for title, curves in panels.items()
    }


def _point(numbers: dict[str, Any]) -> BudgetPoint:
    return BudgetPoint(
        float(numbers["hypotheses_per_query"] or 0.0),
        float(numbers["recall"][_LABEL]),
        *map(float, numbers["recall_interval_95"][_LABEL]),
    )


def _counts(run: StoredRun) -> tuple[int, ...]:
    return tuple(numbers["num_queries"] for numbers in run.summary["splits"].values())


def _words(summary: dict[str, Any]) -> dict[str, str | None]:
    """Returns what may tell lines of one method apart: settings that are words, or none, and the protocol."""
    params, protocol = summary["method"].get("params", {}).items(), summary["protocol"]
    lod, drawn = protocol.get("lod"), protocol.get("prior", "file")
    # A level of detail is named above, numbers of queries where they differ.
    settings = {k: v for k, v in summary.get("settings", {}).items() if k not in ("lod", "limit")}
    return {
        **{key: value for key, value in params if value is None or isinstance(value, str)},
        "protocol.segmenter": str(protocol["segmenter"]),
        "protocol.lod": lod_in_words(str(lod)) if lod else None,
        "protocol.prior": None if drawn == "file" else f"priors {drawn}",
        **{f"data.{key}": None if value is None else f"{key}={value}" for key, value in settings.items()},
    }


def _differing_words(runs: Sequence[StoredRun]) -> dict[str, set[str]]:
    """Returns by method what is words, or none, and that its runs do not agree on."""
    values: dict[str, dict[str, set[str | None]]] = defaultdict(lambda: defaultdict(set))
    for run in runs:
        for key, value in _words(run.summary).items():
            values[run.summary["method"]["name"]][key].add(value)
    return {
        name: {key for key, found in settings.items() if len(found) > 1} for name, settings in values.items()
    }
