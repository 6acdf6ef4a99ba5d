"""One HTML page of several finished runs: tables, curves, and whether they differ, by method names."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from lodbench.evaluation.queries import ERROR, PRIOR_ERROR, has_truth, of_split
from lodbench.evaluation.recall import Threshold
from lodbench.evaluation.statistics import Comparison
from lodbench.harness.runs.compare import agreement, paired_comparison, require_same_queries
from lodbench.harness.runs.stored import StoredRun
from lodbench.reporting.comparison import agreement_text, comparison_cells
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
) -> str:
    """Returns the page, which will lie in the folder ``beside``: links to the runs' pages start there."""
    scored = [(run, name) for run, name in zip(runs, names, strict=True) if has_truth(run.queries).any()]
    curves = {split: _curves(scored, split) for split in _splits(scored)}
    pictures = [
        Picture(draw_comparison(found)["svg"], "svg+xml", _caption(split), "chart")
        for split, found in curves.items()
        if found
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
    )


def _splits(scored: Sequence[tuple[StoredRun, str]]) -> list[str]:
    return list(dict.fromkeys(split for run, _ in scored for split in run.summary["splits"]))


def _curves(scored: Sequence[tuple[StoredRun, str]], split: str) -> list[ErrorCurve]:
    """Returns the errors of each run in a split, and of the priors where all started from the same."""
    curves, priors = [], []
    for run, name in scored:
        mine = of_split(run.queries, split)
        if len(mine):
            curves.append(ErrorCurve(name, mine[list(ERROR)].to_numpy()))
            priors.append(mine[list(PRIOR_ERROR)].to_numpy())
    if curves and all(prior.shape == priors[0].shape and (prior == priors[0]).all() for prior in priors):
        curves.append(ErrorCurve("prior", priors[0]))
    return curves


def _caption(split: str) -> str:
    return (
        f"{split}: recall over a threshold of as many metres as degrees; share of queries below an error in "
        "place and in direction. A failed query is never below."
    )


def _link(folder: Path, beside: Path) -> str:
    """Returns where a run's own page is from here; "" if it has none yet."""
    page = folder / "report.html"
    return Path(os.path.relpath(page.resolve(), beside.resolve())).as_posix() if page.is_file() else ""
