"""What hypotheses buy: recall of both methods as they are allowed to render more of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from lodbench.bench.accuracy import draw_views, open_scenes, part_of, told_width
from lodbench.bench.accuracy_options import AccuracyOptions
from lodbench.bench.figures import Figure, Progress, no_progress
from lodbench.evaluation.queries import ERROR
from lodbench.evaluation.recall import DEFAULT_THRESHOLDS, summarize
from lodbench.methods import Method
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.reporting.calibration_figures import BudgetPoint, draw_budget
from lodbench.reporting.columns import format_columns

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


@dataclass(frozen=True, slots=True)
class BudgetReport:
    """Recall over hypotheses, by method.

    Attributes:
        title: City and protocol in words.
        curves: Points of each method, fewest hypotheses first.
    """

    title: str
    curves: dict[str, tuple[BudgetPoint, ...]]

    def figures(self) -> list[Figure]:
        """Returns the recall of every point."""
        return [
            Figure(f"recall 2m-2deg of {name} at {point.hypotheses:.0f} hypotheses", point.recall, "%")
            for name, points in self.curves.items()
            for point in points
        ]

    def to_text(self) -> str:
        """Returns a table with a line of small print."""
        rows = [["", "hypotheses", "2m-2deg %"]]
        for name, points in self.curves.items():
            for p in points:
                rows.append([name, f"{p.hypotheses:.0f}", f"{p.recall:.1f} [{p.low:.1f}, {p.high:.1f}]"])
        return format_columns(rows) + "\n" + self.title

    def write_pictures(self, folder: Path) -> None:
        """Writes ``budget.png`` and ``budget.svg``."""
        from lodbench.storage.atomic import write_bytes

        folder.mkdir(parents=True, exist_ok=True)
        for kind, picture in draw_budget(self.curves, self.title.split(",")[0]).items():
            write_bytes(folder / f"budget.{kind}", picture)


def measure_budget(city: Path, options: AccuracyOptions, progress: Progress = no_progress) -> BudgetReport:
    """Returns what both methods find with few and with many hypotheses, the sensor's tilt in the prior.

    Args:
        city: City model file.
        options: The views, as for accuracy.
        progress: Called after each view.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    import pandas as pd

    scorer, seen = open_scenes(city, options)
    drawn = [draw_views(scorer, seen, options, seed) for seed in options.seeds]
    curves: dict[str, list[BudgetPoint]] = {}
    jobs = [(told_width(method, options.prior()), views) for method in _ladder() for views in drawn]
    tables = [
        views.find(method, "prior", scorer, part_of(progress, number, len(jobs)))[0]
        for number, (method, views) in enumerate(jobs)
    ]
    for start in range(0, len(jobs), len(drawn)):
        found = pd.concat(tables[start : start + len(drawn)])
        summary = summarize(found[list(ERROR)].to_numpy())
        label = DEFAULT_THRESHOLDS[0].label
        point = BudgetPoint(
            float(found["hypotheses"].mean()), summary.recall[label], *summary.interval[label]
        )
        curves.setdefault(jobs[start][0].name, []).append(point)
    count = options.num_views * len(drawn)
    title = f"{Path(city).name}: {count} views with tilt=prior, {options.protocol()}"
    return BudgetReport(title, {name: tuple(points) for name, points in curves.items()})


def _ladder() -> list[Method]:
    paper, ours = LodLocV2().params, ContourAlignment().params
    methods: list[Method] = [LodLocV2(replace(paper, variant="no_refine"))]
    methods += [LodLocV2(replace(paper, steps=steps)) for steps in _STEPS]
    for stride_m, stride_yaw_deg, starts, steps in _SETTINGS:
        wider = replace(ours, stride_m=stride_m, stride_yaw_deg=stride_yaw_deg)
        methods.append(ContourAlignment(replace(wider, starts=starts, steps=steps)))
    return methods
