"""What hypotheses buy: recall of both methods as they are allowed to render more of them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.command import run
from lodbench.bench import Figure, Progress, Report, no_progress
from lodbench.bench.accuracy import Job, of_seeds, protocol_of, sweep
from lodbench.cli.bench_views import DrawnOptions
from lodbench.evaluation.metrics import ERROR
from lodbench.evaluation.pose_errors import DEFAULT_THRESHOLDS, summarize
from lodbench.methods import Method
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.params import flag, part
from lodbench.reporting.aligned_text import count_of, format_columns
from lodbench.reporting.figures import BudgetPoint, draw_budget
from lodbench.synthesis.views_dataset import ViewsParams

if TYPE_CHECKING:
    import pandas as pd

# Filter steps of LoD-Loc v2, after its grid alone.
_STEPS = (2, 5, 10, 20, 40, 80, 160)
# Grid strides in metres and degrees, starts and alignment steps of the other, fewest hypotheses first.
_SETTINGS = (
    (30.0, 7.5, 1, 6),
    (20.0, 5.0, 2, 8),
    (20.0, 5.0, 8, 10),
    (10.0, 2.15, 1, 10),
    (10.0, 2.15, 8, 10),
    (10.0, 2.15, 32, 10),
    (10.0, 2.15, 128, 10),
)
_LABEL = DEFAULT_THRESHOLDS[0].label


def measure_budget(
    views: ViewsParams, seeds: Sequence[int], progress: Progress = no_progress, threads: int | None = None
) -> Report:
    """Returns what both methods find with few and with many hypotheses, the sensor's tilt in the prior.

    ``data`` is the table of ``sweep`` with the column ``rung``: the setting of the method.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    drawn = of_seeds(views, seeds)
    jobs = [Job(method, v, labels={"rung": n}) for n, method in enumerate(_ladder()) for v in drawn]
    queries = sweep(jobs, progress, threads)
    curves: dict[str, list[BudgetPoint]] = {}
    for _, rows in queries.groupby("rung"):
        curves.setdefault(rows["method"].iloc[0], []).append(_point(rows))
    points = [(method, point) for method, curve in curves.items() for point in curve]
    figures = [
        Figure(f"recall {_LABEL} of {m} at {p.hypotheses:.0f} hypotheses", p.recall, "%") for m, p in points
    ]
    cells = [[m, f"{p.hypotheses:.0f}", f"{p.recall:.1f} [{p.low:.1f}, {p.high:.1f}]"] for m, p in points]
    count = (
        f"{Path(views.city_model).name}: {count_of(views.num_views * len(drawn), 'views')} with tilt=prior"
    )
    table = format_columns([["", "hypotheses", f"{_LABEL} %"], *cells])
    return Report(
        f"{table}\n{count}, {protocol_of(views, seeds)}", figures, queries, partial(_pictures, curves, count)
    )


def _point(rows: pd.DataFrame) -> BudgetPoint:
    summary = summarize(rows[list(ERROR)].to_numpy())
    return BudgetPoint(float(rows["hypotheses"].mean()), summary.recall[_LABEL], *summary.interval[_LABEL])


def _pictures(curves: dict[str, list[BudgetPoint]], title: str) -> dict[str, bytes]:
    return {f"budget.{kind}": picture for kind, picture in draw_budget({title: curves}).items()}


def _ladder() -> list[Method]:
    paper, ours = LodLocV2().params, ContourAlignment().params
    methods: list[Method] = [LodLocV2(replace(paper, variant="no_refine"))]
    methods += [LodLocV2(replace(paper, steps=steps)) for steps in _STEPS]
    for stride_m, stride_yaw_deg, starts, steps in _SETTINGS:
        wider = replace(ours, stride_m=stride_m, stride_yaw_deg=stride_yaw_deg)
        methods.append(ContourAlignment(replace(wider, starts=starts, steps=steps)))
    return methods


@dataclass(frozen=True, kw_only=True)
class Drawn(DrawnOptions):
    """What is drawn."""

    views: int = flag(50, "seeded views (50)", sets=("dataset.num_views",))


@dataclass(frozen=True, kw_only=True)
class BudgetOptions:
    """What is measured."""

    city: Path | None = flag(None, "city model; the demo town if not given")
    drawn: Drawn = part(Drawn)


def _measured(given: BudgetOptions, steps: Progress) -> Report:
    return measure_budget(given.drawn.over(given.city), given.drawn.each_seed(), steps)


if __name__ == "__main__":
    sys.exit(run("budget", BudgetOptions, _measured))
