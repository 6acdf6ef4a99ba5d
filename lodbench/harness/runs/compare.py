"""Stored runs beside each other: tests of paired queries, a page of all, recall over poses drawn."""

from __future__ import annotations

import math
import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.citymodel.model import lod_in_words
from lodbench.evaluation import pose_errors
from lodbench.evaluation.metrics import ERROR, PRIOR_ERROR, has_truth, of_split
from lodbench.evaluation.pose_errors import Agreement, Comparison, mcnemar, paired_medians
from lodbench.evaluation.predictions import Prediction
from lodbench.geometry import Pose
from lodbench.harness.runs.predict import PREDICTIONS_FILE, open_predictions
from lodbench.harness.runs.stored import StoredRun
from lodbench.reporting import figures
from lodbench.reporting.aligned_text import count_of
from lodbench.reporting.page import Picture, markup, rendered
from lodbench.reporting.tables import RecallTable, format_html

# A pose read back from text is off by rounding: 1e-9 m at coordinates of 5,000 km. A number that
# matters to anybody is 1000 times coarser than this.
TOLERANCE_M, TOLERANCE_DEG = 1e-6, 1e-6
# What a method says of an answer, which is written with all its digits.
_STATED = ("score", "hypotheses", "probability")
_LABEL = pose_errors.DEFAULT_THRESHOLDS[0].label
Curves = dict[str, list[figures.BudgetPoint]]


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
    for key, stated in zip(stored.queries.index, stored.queries.to_dict("records"), strict=True):
        if key not in ledger:
            lines.append(f"{PREDICTIONS_FILE}: {key} is missing")
            continue
        answer = Prediction.from_json(ledger[key], f"{stored.folder / PREDICTIONS_FILE}: {key}")
        if not _is_same(answer.pose, stored.poses.get(key)):
            lines.append(f"{PREDICTIONS_FILE}: {key} has another pose than poses.txt")
        lines += [
            f"{PREDICTIONS_FILE}: {key} has another {name} than queries.csv"
            for name in _STATED
            if bool(stored.queries[name].notna().any()) and not _is_equal(stated[name], getattr(answer, name))
        ]
    return lines


def _is_equal(reported: float, stored: float | None) -> bool:
    return math.isnan(reported) if stored is None else reported == stored


def _is_same(one: Pose | None, other: Pose | None) -> bool:
    if one is None or other is None:
        return one is other
    error = pose_errors.pose_error(one, other)
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
    first: StoredRun, second: StoredRun, thresholds: Sequence[pose_errors.Threshold]
) -> list[Comparison]:
    """Returns the tests of each split: recall at each threshold, and the median errors."""
    tests = []
    for split in first.summary["splits"]:
        scored = of_split(first.queries, split)
        if scored.empty:
            continue  # no truth to be tested against
        errors = list(ERROR)
        a, b = scored[errors].to_numpy(), second.queries.loc[scored.index, errors].to_numpy()
        for threshold in thresholds:
            hits = pose_errors.hits_of(a, threshold), pose_errors.hits_of(b, threshold)
            before, after = (100.0 * float(hit.mean()) for hit in hits)
            tests.append(Comparison(split, f"recall {threshold.label}", "%", before, after, mcnemar(*hits)))
        for column, (name, unit) in enumerate((("median translation", "m"), ("median rotation", "deg"))):
            x, y = a[:, column], b[:, column]
            medians = float(np.median(x)), float(np.median(y))
            tests.append(Comparison(split, name, unit, *medians, paired_medians(x, y)))
    return tests


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
    differences = answers_apart(first, second)
    reach = sum(run.queries.loc[list(differences), list(ERROR)].to_numpy() for run in (first, second))
    errors = np.array([each.error for each in differences.values()]).reshape(-1, 2)
    if (errors > reach + TOLERANCE_M).any():  # never where a truth, NaN, is not known
        return "the names are the same, but not the true poses"
    return ""


def answers_apart(first: StoredRun, second: StoredRun) -> dict[str, pose_errors.Apart]:
    """Returns how far the answers of two runs lie apart, by ``split/query``, where both answered."""
    shared = [key for key in first.poses if key in second.poses]
    return {key: pose_errors.apart(second.poses[key], first.poses[key]) for key in shared}


def agreement(first: StoredRun, second: StoredRun) -> Agreement | None:
    """Returns how far the answers of two runs lie apart; None where no photo has an answer of both."""
    if why_other_photos(first, second):
        return None
    differences = answers_apart(first, second).values()
    if not differences:
        return None
    errors = np.array([each.error for each in differences])
    parts = np.abs([[each.parts.horizontal_m, each.parts.vertical_m] for each in differences])
    within = int(pose_errors.hits_of(errors, pose_errors.PROBABILITY_THRESHOLD).sum())
    medians = [*np.median(errors, axis=0), *np.median(parts, axis=0)]
    return Agreement(len(differences), within, *map(float, medians))


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


def _point(numbers: dict[str, Any]) -> figures.BudgetPoint:
    return figures.BudgetPoint(
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
        name: {key for key, words in settings.items() if len(words) > 1} for name, settings in values.items()
    }


def comparison_page(
    runs: Sequence[StoredRun],
    names: Sequence[str],
    tables: Sequence[RecallTable],
    thresholds: Sequence[pose_errors.Threshold],
    beside: Path,
    photos: str,
    no_photos: str,
) -> str:
    """Returns the page, whose links start in ``beside``; ``photos`` is its part by ``photo_pairs_of``."""
    scored = [(run, name) for run, name in zip(runs, names, strict=True) if has_truth(run.queries).any()]
    pictures = [
        Picture(
            figures.draw_comparison(_curves(members, split))["svg"], "svg+xml", _caption(split, of), "chart"
        )
        for (split, of), members in _charts(scored).items()
    ]
    pairs = []
    for run, name in zip(runs[1:], names[1:], strict=True):
        reason = require_same_queries(runs[0], run)
        tests: list[Comparison] = [] if reason else paired_comparison(runs[0], run, thresholds)
        together = agreement(runs[0], run)
        pairs.append(
            (
                f"{name} against {names[0]}",
                reason,
                figures.comparison_cells(tests, (names[0], name)),
                figures.agreement_text(together),
            )
        )
    return rendered(
        "compare.html.jinja",
        runs=[
            (name, str(run.folder), link_to(run.folder / "report.html", beside))
            for run, name in zip(runs, names, strict=True)
        ],
        tables=[markup(format_html(table)) for table in tables],
        pictures=pictures,
        pairs=pairs,
        note=figures.PAIRED_NOTE if any(not reason for _, reason, _, _ in pairs) else "",
        photos=markup(photos),
        no_photos=no_photos,
    )


def _charts(scored: Sequence[tuple[StoredRun, str]]) -> dict[tuple[str, str], list[tuple[StoredRun, str]]]:
    """Returns the runs of each chart, by split and by what tells it from other charts of that split.

    Only errors of the same queries are drawn together.
    """
    groups: dict[tuple[str, str, frozenset[Any]], list[tuple[StoredRun, str]]] = {}
    for run, name in scored:
        dataset = run.summary["dataset"]
        words = f"{dataset['name']} ({dataset['version']})" if dataset["version"] else dataset["name"]
        for split in run.summary["splits"]:
            if keys := frozenset(of_split(run.queries, split).index):
                groups.setdefault((split, words, keys), []).append((run, name))
    per_split = Counter(split for split, _, _ in groups)
    charts: dict[tuple[str, str], list[tuple[StoredRun, str]]] = {}
    for number, ((split, words, keys), members) in enumerate(groups.items(), start=1):
        of = f"{words}, {count_of(len(keys), 'queries')}" if per_split[split] > 1 else ""
        charts[split, f"{of}, chart {number}" if (split, of) in charts else of] = members
    return charts


def _curves(scored: Sequence[tuple[StoredRun, str]], split: str) -> list[figures.ErrorCurve]:
    """Returns the errors of each run in a split, and of the priors where all started from the same."""
    curves, priors = [], []
    for run, name in scored:
        mine = of_split(run.queries, split)
        curves.append(figures.ErrorCurve(name, mine[list(ERROR)].to_numpy()))
        priors.append(mine[list(PRIOR_ERROR)].to_numpy())
    if all(prior.shape == priors[0].shape and (prior == priors[0]).all() for prior in priors):
        curves.append(figures.ErrorCurve("prior", priors[0]))
    return curves


def _caption(split: str, of: str) -> str:
    name = f"{split} of {of}" if of else split
    return (
        f"{name}: recall over a threshold of as many metres as degrees; share of queries below an error in "
        "place and in direction. A failed query is never below."
    )


def link_to(page: Path, beside: Path) -> str:
    """Returns where a page is from a folder; "" if it is not there."""
    return Path(os.path.relpath(page.resolve(), beside.resolve())).as_posix() if page.is_file() else ""
