"""Priors and ends on real photos: recall, whether wrong answers are known, and a picture of basins."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.bench.figures import Figure
from lodbench.evaluation import PoseError
from lodbench.evaluation.statistics import wilson_interval
from lodbench.reporting.columns import format_columns
from lodbench.reporting.figures import SERIES, draw_figure
from lodbench.storage.atomic import write_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Floats = NDArray[np.float64]

LIMITS = ((2.0, 1.0), (2.0, 2.0), (3.0, 3.0), (5.0, 5.0))
# A right answer, and the share of them that a threshold on the probability lets through.
_RIGHT = (2.0, 2.0)
_KEPT = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One prior and what became of it.

    Attributes:
        photo: Its name.
        number: Of the drawn prior; None for the dataset's own.
        prior_offset_m: (3,) prior less truth, metres east, north and up.
        offset_m: (3,) answer less truth; NaN without an answer.
        prior_error: Of the prior.
        error: Of the answer; infinite without one.
        score: The method's.
        probability: That the answer is within 2 m and 2 degrees, by the method; None where it says none.
        seconds: Wall time.
        cpu_seconds: Time on all cores.
        failure: Why there is no answer, or nothing.
    """

    photo: str
    number: int | None
    prior_offset_m: Floats
    offset_m: Floats
    prior_error: PoseError
    error: PoseError
    score: float
    probability: float | None
    seconds: float
    cpu_seconds: float
    failure: str

    def is_within(self, limit: tuple[float, float]) -> bool:
        """Tells whether the answer is nearer than metres and degrees."""
        return self.error.translation_m < limit[0] and self.error.rotation_deg < limit[1]


@dataclass(frozen=True, slots=True, eq=False)
class MethodOutcome:
    """All trials of one method."""

    method: str
    trials: tuple[Trial, ...]

    def found(self, limit: tuple[float, float]) -> NDArray[np.bool_]:
        """Returns (N,) which answers are nearer than metres and degrees."""
        return np.array([trial.is_within(limit) for trial in self.trials])

    def medians(self) -> tuple[float, float]:
        """Returns the median errors, metres and degrees."""
        errors = np.array([(t.error.translation_m, t.error.rotation_deg) for t in self.trials])
        return float(np.median(errors[:, 0])), float(np.median(errors[:, 1]))

    def flagged(self) -> float | None:
        """Returns the share of wrong answers below the threshold that 90 % of right ones pass.

        None where the method says no probability, or nothing is wrong or nothing right.
        """
        said = np.array([np.nan if t.probability is None else t.probability for t in self.trials])
        right = self.found(_RIGHT)
        if np.isnan(said).any() or right.all() or not right.any():
            return None
        return float(np.mean(said[~right] < np.quantile(said[right], 1.0 - _KEPT)))


@dataclass(frozen=True, slots=True, eq=False)
class RealReport:
    """What was measured.

    Attributes:
        data: Name of the dataset.
        protocol: The priors in words.
        outcomes: One per method.
    """

    data: str
    protocol: str
    outcomes: tuple[MethodOutcome, ...]

    def figures(self) -> list[Figure]:
        """Returns recall, medians and times by method."""
        figures = []
        for outcome in self.outcomes:
            name, count = outcome.method, len(outcome.trials)
            for limit in LIMITS:
                share = 100.0 * float(outcome.found(limit).mean())
                figures.append(Figure(f"{name}: recall {limit[0]:g}m-{limit[1]:g}deg", share, "%"))
            metres, degrees = outcome.medians()
            figures += [
                Figure(f"{name}: median translation", metres, "m"),
                Figure(f"{name}: median rotation", degrees, "deg"),
                Figure(f"{name}: priors", float(count), ""),
                Figure(f"{name}: seconds", float(np.median([t.seconds for t in outcome.trials])), "s"),
                Figure(
                    f"{name}: CPU seconds", float(np.median([t.cpu_seconds for t in outcome.trials])), "s"
                ),
            ]
            flagged = outcome.flagged()
            if flagged is not None:
                figures.append(
                    Figure(f"{name}: wrong answers flagged, 90 % of right kept", 100.0 * flagged, "%")
                )
        return figures

    def to_text(self) -> str:
        """Returns a table of methods, and one of trials."""
        return "\n".join([f"{self.data}: priors {self.protocol}", self._summary(), "", self._trials()])

    def _summary(self) -> str:
        head = [f"{m:g} m, {d:g} deg" for m, d in LIMITS]
        cells = [["method", *head, "95 % at 2 m, 2 deg", "median", "s", "CPU s", "wrong flagged"]]
        for outcome in self.outcomes:
            count, metres = len(outcome.trials), outcome.medians()
            low, high = wilson_interval(outcome.found(_RIGHT))
            flagged = outcome.flagged()
            cells.append(
                [
                    outcome.method,
                    *(f"{int(outcome.found(limit).sum())} of {count}" for limit in LIMITS),
                    f"{low:.0f} to {high:.0f} %",
                    f"{metres[0]:.2f} m, {metres[1]:.2f} deg",
                    f"{np.median([t.seconds for t in outcome.trials]):.2f}",
                    f"{np.median([t.cpu_seconds for t in outcome.trials]):.2f}",
                    "-" if flagged is None else f"{100 * flagged:.0f} %",
                ]
            )
        return format_columns(cells)

    def _trials(self) -> str:
        cells = [["method", "photo", "prior", "off by", "error", "score", "probability", ""]]
        for outcome in self.outcomes:
            for t in outcome.trials:
                cells.append(
                    [
                        outcome.method,
                        t.photo,
                        "published" if t.number is None else str(t.number),
                        f"{t.prior_error.translation_m:.1f} m, {t.prior_error.rotation_deg:.1f} deg",
                        f"{t.error.translation_m:.2f} m, {t.error.rotation_deg:.2f} deg",
                        f"{t.score:.3f}",
                        "-" if t.probability is None else f"{t.probability:.2f}",
                        t.failure,
                    ]
                )
        return format_columns(cells)

    def write_picture(self, folder: Path) -> None:
        """Writes ``basins.png`` and ``basins.svg``: from each prior to where it ended, seen from above."""
        folder.mkdir(parents=True, exist_ok=True)

        def draw(canvas: Canvas) -> None:
            axes = canvas.subplots(1, len(self.outcomes), squeeze=False)[0]
            for axis, outcome in zip(axes, self.outcomes, strict=True):
                _draw_basins(axis, outcome)

        for kind, picture in draw_figure(5.0 * len(self.outcomes), 5.0, draw).items():
            write_bytes(folder / f"basins.{kind}", picture)


def _draw_basins(axis, outcome: MethodOutcome) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
    for trial in outcome.trials:
        start, end = trial.prior_offset_m[:2], trial.offset_m[:2]
        colour = SERIES[0] if trial.is_within(_RIGHT) else SERIES[1]
        axis.plot(*np.column_stack([start, end]), color=colour, alpha=0.4, linewidth=1.0)
        axis.plot(*start, "o", color=colour, markersize=3, fillstyle="none")
        axis.plot(*end, "o", color=colour, markersize=4)
    axis.plot(0.0, 0.0, "+", color="black", markersize=12)
    right = int(outcome.found(_RIGHT).sum())
    axis.set(
        title=f"{outcome.method}: {right} of {len(outcome.trials)} within 2 m and 2 deg",
        xlabel="east of the truth, m",
        ylabel="north of the truth, m",
        aspect="equal",
    )
