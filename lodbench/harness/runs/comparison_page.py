"""One HTML page of several finished runs: tables, curves, and whether they differ, by method names."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lodbench.evaluation.queries import ERROR, PRIOR_ERROR, has_truth, of_split
from lodbench.evaluation.recall import Threshold
from lodbench.evaluation.statistics import Comparison
from lodbench.harness.runs.compare import agreement, paired_comparison, require_same_queries
from lodbench.harness.runs.stored import StoredRun
from lodbench.reporting.aligned_text import count_of
from lodbench.reporting.comparison import PAIRED_NOTE, agreement_text, comparison_cells
from lodbench.reporting.comparison_figures import ErrorCurve, draw_comparison
from lodbench.reporting.page import Picture, markup, rendered
from lodbench.reporting.table_formats import format_html
from lodbench.reporting.tables import RecallTable


def comparison_page(
    runs: Sequence[StoredRun],
    names: Sequence[str],
    tables: Sequence[RecallTable],
    thresholds: Sequence[Threshold],
    beside: Path,
    photos: str,
    no_photos: str,
) -> str:
    """Returns the page.

    Args:
        runs: The runs.
        names: Of each.
        tables: Of those that have a truth.
        thresholds: Where to test recall.
        beside: Folder of the page: links to the runs' pages start there.
        photos: The part that shows two runs photo by photo (``photo_pairs_of``); "" for none.
        no_photos: Why there is none; "" for nothing to say.
    """
    scored = [(run, name) for run, name in zip(runs, names, strict=True) if has_truth(run.queries).any()]
    pictures = [
        Picture(draw_comparison(_curves(found, split))["svg"], "svg+xml", _caption(split, of), "chart")
        for (split, of), found in _charts(scored).items()
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
                comparison_cells(tests, (names[0], name)),
                agreement_text(together),
            )
        )
    return rendered(
        "compare.html.jinja",
        runs=[
            (name, str(run.folder), _link(run.folder, beside)) for run, name in zip(runs, names, strict=True)
        ],
        tables=[markup(format_html(table)) for table in tables],
        pictures=pictures,
        pairs=pairs,
        note=PAIRED_NOTE if any(not reason for _, reason, _, _ in pairs) else "",
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
    for number, ((split, words, keys), found) in enumerate(groups.items(), start=1):
        of = f"{words}, {count_of(len(keys), 'queries')}" if per_split[split] > 1 else ""
        charts[split, f"{of}, chart {number}" if (split, of) in charts else of] = found
    return charts


def _curves(scored: Sequence[tuple[StoredRun, str]], split: str) -> list[ErrorCurve]:
    """Returns the errors of each run in a split, and of the priors where all started from the same."""
    curves, priors = [], []
    for run, name in scored:
        mine = of_split(run.queries, split)
        curves.append(ErrorCurve(name, mine[list(ERROR)].to_numpy()))
        priors.append(mine[list(PRIOR_ERROR)].to_numpy())
    if all(prior.shape == priors[0].shape and (prior == priors[0]).all() for prior in priors):
        curves.append(ErrorCurve("prior", priors[0]))
    return curves


def _caption(split: str, of: str) -> str:
    name = f"{split} of {of}" if of else split
    return (
        f"{name}: recall over a threshold of as many metres as degrees; share of queries below an error in "
        "place and in direction. A failed query is never below."
    )


def _link(folder: Path, beside: Path) -> str:
    """Returns where a run's own page is from here; "" if it has none yet."""
    page = folder / "report.html"
    return Path(os.path.relpath(page.resolve(), beside.resolve())).as_posix() if page.is_file() else ""
