"""The accuracy figures as data and as text: recalls and medians of methods beside their priors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from lodbench.bench.figures import Figure
from lodbench.evaluation import DEFAULT_THRESHOLDS, PoseError, SplitSummary, summarize
from lodbench.evaluation.calibration import Calibration, calibrate
from lodbench.reporting.columns import format_columns

# The two blocks: pitch and roll of the prior true, or drawn with an error.
TILTS = ("truth", "prior")


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one case.

    Attributes:
        name: The view.
        tilt: ``truth`` or ``prior``.
        error: Error of the estimate.
        prior_error: Error of the prior.
        score: The method's score of its estimate; 0 without one.
        truth_score: IoU of the mask with the silhouette at the truth: a lower score than this is a
            failure of the search, a higher one says that the mask fits a wrong pose better.
        hypotheses: Poses scored.
        seconds: Wall time.
        method: Name of the method.
        seed: Which draw of views the case belongs to.
        probability: What the method said of its being within (2 m, 2 deg); None if it does not say.
    """

    name: str
    tilt: str
    error: PoseError
    prior_error: PoseError
    score: float
    truth_score: float
    hypotheses: int
    seconds: float
    method: str = "lodlocv2"
    seed: int = 0
    probability: float | None = None

    @property
    def is_found(self) -> bool:
        """Tells whether the estimate lies within (2 m, 2 deg)."""
        return self.error.translation_m < 2 and self.error.rotation_deg < 2


@dataclass(frozen=True, slots=True)
class AccuracyReport:
    """Outcomes of every method and view under both tilts.

    Attributes:
        city: File name of the city model.
        methods: Names of the methods.
        protocol: What was drawn, in words.
        rejections: Draws of a view thrown away: too few or too many buildings, or among them.
        outcomes: One per seed, method, tilt and view, in that order.
    """

    city: str
    methods: tuple[str, ...]
    protocol: str
    rejections: int
    outcomes: tuple[Outcome, ...]

    def of_tilt(self, tilt: str, method: str | None = None) -> tuple[Outcome, ...]:
        """Returns the outcomes of ``truth`` or ``prior``, of a method; the first if None."""
        method = method or self.methods[0]
        return tuple(o for o in self.outcomes if o.tilt == tilt and o.method == method)

    def summary(self, tilt: str, method: str | None = None) -> SplitSummary:
        """Returns a method's recalls and medians under a tilt."""
        outcomes = self.of_tilt(tilt, method)
        return summarize([o.error for o in outcomes], [o.hypotheses for o in outcomes if o.hypotheses])

    def prior_summary(self, tilt: str) -> SplitSummary:
        """Returns the same of the priors themselves."""
        return summarize([o.prior_error for o in self.of_tilt(tilt)])

    def seconds_per_query(self, tilt: str, method: str | None = None) -> float:
        """Returns the mean wall time of a query."""
        return float(np.mean([o.seconds for o in self.of_tilt(tilt, method)]))

    def calibration(self, tilt: str, method: str) -> Calibration | None:
        """Returns how well a method knows what it found; None if it does not say."""
        outcomes = self.of_tilt(tilt, method)
        if all(o.probability is None for o in outcomes):
            return None
        return calibrate([o.probability or 0.0 for o in outcomes], [o.is_found for o in outcomes])

    def calibrations(self) -> dict[str, Calibration]:
        """Returns the calibrations there are, by method and tilt in words."""
        asked = {f"{method}, tilt={tilt}": self.calibration(tilt, method) for method, tilt in self._blocks()}
        return {name: calibration for name, calibration in asked.items() if calibration is not None}

    def figures(self) -> list[Figure]:
        """Returns one figure per number; the peer of each is the prior."""
        return [figure for method, tilt in self._blocks() for figure in self._figures_of(method, tilt)]

    def to_text(self) -> str:
        """Returns the report as a table with a line of small print for each block."""
        labels = [t.label for t in DEFAULT_THRESHOLDS]
        recalls = [f"{label} %" for label in labels]
        head = [
            "",
            *recalls,
            "median m",
            "median deg",
            "hypotheses",
            "s/query",
            "said-found %",
            "risk area %",
        ]
        rows = [head]
        for tilt in TILTS:
            rows.append([*_cells(f"tilt={tilt}  prior", self.prior_summary(tilt), "-"), "-", "-"])
            for method in self.methods:
                seconds = f"{self.seconds_per_query(tilt, method):.2f}"
                cells = _cells(f"tilt={tilt}  {method}", self.summary(tilt, method), seconds)
                rows.append([*cells, *_knowing(self.calibration(tilt, method))])
        return format_columns(rows) + "\n" + self._small_print()

    def _blocks(self) -> list[tuple[str, str]]:
        return [(method, tilt) for tilt in TILTS for method in self.methods]

    def _figures_of(self, method: str, tilt: str) -> Iterable[Figure]:
        ours, prior = self.summary(tilt, method), self.prior_summary(tilt)
        block = f"tilt={tilt}" if len(self.methods) == 1 else f"{method} tilt={tilt}"
        for label, percent in ours.recall.items():
            yield Figure(f"recall {label} {block}", percent, "%", "prior", prior.recall[label])
            low, high = ours.interval[label]
            yield Figure(f"recall {label} {block} low", low, "%")
            yield Figure(f"recall {label} {block} high", high, "%")
        for name, unit in (("median_translation_m", "m"), ("median_rotation_deg", "deg")):
            value, beside = getattr(ours, name), getattr(prior, name)
            ratio = beside / value if value else None
            yield Figure(f"{name} {block}", value, unit, "prior", beside, ratio)
        yield Figure(f"hypotheses per query {block}", ours.hypotheses_per_query, "")
        yield Figure(f"seconds per query {block}", self.seconds_per_query(tilt, method), "s")
        calibration = self.calibration(tilt, method)
        if calibration is not None:
            yield Figure(f"calibration error {block}", 100 * calibration.calibration_error, "%")
            yield Figure(f"area under risk over coverage {block}", 100 * calibration.risk_area, "%")

    def _small_print(self) -> str:
        views = len(self.of_tilt(TILTS[0]))
        lines = [
            f"{self.city}, {views} views ({self.rejections} draws rejected), "
            f"{self.protocol}; in brackets the 95 % interval."
        ]
        for method, tilt in self._blocks():
            missed = [o for o in self.of_tilt(tilt, method) if not o.is_found]
            unfound = sum(o.score < o.truth_score for o in missed)
            whose = f"tilt={tilt}" if len(self.methods) == 1 else f"tilt={tilt} {method}"
            lines.append(
                f"{whose}: {len(missed)} not within (2 m, 2 deg); in {unfound} of them the truth fits "
                f"better than the estimate, in {len(missed) - unfound} it does not."
            )
        if self.calibrations():
            lines.append(
                "said-found: mean distance of the probability a method gives of being within (2 m, 2 deg) "
                "from the share it found; risk area: share not found as the surest 0 to 100 % are answered, "
                "averaged."
            )
        return "\n".join(lines)


def _knowing(calibration: Calibration | None) -> list[str]:
    if calibration is None:
        return ["-", "-"]
    return [f"{100 * calibration.calibration_error:.1f}", f"{100 * calibration.risk_area:.2f}"]


def _cells(name: str, summary: SplitSummary, seconds: str) -> list[str]:
    recalls = []
    for label, percent in summary.recall.items():
        low, high = summary.interval[label]
        recalls.append(f"{percent:.1f} [{low:.1f}, {high:.1f}]")
    answered = f"{summary.hypotheses_per_query:.0f}" if summary.hypotheses_per_query > 0 else "-"
    medians = [f"{summary.median_translation_m:.2f}", f"{summary.median_rotation_deg:.2f}"]
    return [name, *recalls, *medians, answered, seconds]
