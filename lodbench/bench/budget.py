"""What hypotheses buy: recall of both methods as they are allowed to render more of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lodbench.bench.accuracy import open_scenes, reaching, run_case, seeded_cases
from lodbench.bench.accuracy_options import AccuracyOptions
from lodbench.bench.figures import Figure, Progress, no_progress
from lodbench.evaluation.statistics import wilson_interval
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
    scorer, seen = open_scenes(city, options)
    cases = seeded_cases(scorer, seen, options)
    curves: dict[str, list[BudgetPoint]] = {}
    ladder = [reaching(method, options.prior()) for method in _ladder()]
    for k, method in enumerate(ladder):
        outcomes = []
        for n, (seed, case) in enumerate(cases, start=1):
            outcomes.append(run_case(case, "prior", method, scorer, seed))
            progress(k * len(cases) + n, len(ladder) * len(cases))
        found = np.array([outcome.is_found for outcome in outcomes])
        hypotheses = float(np.mean([outcome.hypotheses for outcome in outcomes]))
        point = BudgetPoint(hypotheses, 100.0 * float(found.mean()), *wilson_interval(found))
        curves.setdefault(method.name, []).append(point)
    views = f"{len(cases)} views"
    title = f"{Path(city).name}: {views} with tilt=prior, {options.protocol()}"
    return BudgetReport(title, {name: tuple(points) for name, points in curves.items()})


def _ladder() -> list[Method]:
    paper, ours = LodLocV2().params, ContourAlignment().params
    methods: list[Method] = [LodLocV2(replace(paper, variant="no_refine"))]
    methods += [LodLocV2(replace(paper, steps=steps)) for steps in _STEPS]
    for stride_m, stride_yaw_deg, starts, steps in _SETTINGS:
        wider = replace(ours, stride_m=stride_m, stride_yaw_deg=stride_yaw_deg)
        methods.append(ContourAlignment(replace(wider, starts=starts, steps=steps)))
    return methods
