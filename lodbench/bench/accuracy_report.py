"""The accuracy figures as data and as text: recalls and medians of a method beside its priors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from lodbench.bench.figures import Figure
from lodbench.evaluation import DEFAULT_THRESHOLDS, PoseError, SplitSummary, summarize
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
    """

    name: str
    tilt: str
    error: PoseError
    prior_error: PoseError
    score: float
    truth_score: float
    hypotheses: int
    seconds: float

    @property
    def is_found(self) -> bool:
        """Tells whether the estimate lies within (2 m, 2 deg)."""
        return self.error.translation_m < 2 and self.error.rotation_deg < 2


@dataclass(frozen=True, slots=True)
class AccuracyReport:
    """Outcomes of every view under both tilts.

    Attributes:
        city: File name of the city model.
        method: Name of the method.
        protocol: What was drawn, in words.
        rejections: Draws of a view thrown away: too few or too many buildings, or among them.
        outcomes: One per view and tilt, in that order.
    """

    city: str
    method: str
    protocol: str
    rejections: int
    outcomes: tuple[Outcome, ...]

    def of_tilt(self, tilt: str) -> tuple[Outcome, ...]:
        """Returns the outcomes of ``truth`` or ``prior``."""
        return tuple(outcome for outcome in self.outcomes if outcome.tilt == tilt)

    def summary(self, tilt: str) -> SplitSummary:
        """Returns the method's recalls and medians under a tilt."""
        outcomes = self.of_tilt(tilt)
        return summarize([o.error for o in outcomes], [o.hypotheses for o in outcomes if o.hypotheses])

    def prior_summary(self, tilt: str) -> SplitSummary:
        """Returns the same of the priors themselves."""
        return summarize([o.prior_error for o in self.of_tilt(tilt)])

    def seconds_per_query(self, tilt: str) -> float:
        """Returns the mean wall time of a query."""
        return float(np.mean([o.seconds for o in self.of_tilt(tilt)]))

    def figures(self) -> list[Figure]:
        """Returns one figure per number; the peer of each is the prior."""
        return [figure for tilt in TILTS for figure in self._figures_of(tilt)]

    def to_text(self) -> str:
        """Returns the report as a table with a line of small print."""
        labels = [t.label for t in DEFAULT_THRESHOLDS]
        head = ["", *(f"{label} %" for label in labels), "median m", "median deg", "hypotheses", "s/query"]
        rows = [head]
        for tilt in TILTS:
            seconds = f"{self.seconds_per_query(tilt):.2f}"
            rows.append(_cells(f"tilt={tilt}  prior", self.prior_summary(tilt), "-"))
            rows.append(_cells(f"tilt={tilt}  {self.method}", self.summary(tilt), seconds))
        return format_columns(rows) + "\n" + self._small_print()

    def _figures_of(self, tilt: str) -> Iterable[Figure]:
        ours, prior = self.summary(tilt), self.prior_summary(tilt)
        for label, percent in ours.recall.items():
            yield Figure(f"recall {label} tilt={tilt}", percent, "%", "prior", prior.recall[label])
            low, high = ours.interval[label]
            yield Figure(f"recall {label} tilt={tilt} low", low, "%")
            yield Figure(f"recall {label} tilt={tilt} high", high, "%")
        for name, unit in (("median_translation_m", "m"), ("median_rotation_deg", "deg")):
            value, beside = getattr(ours, name), getattr(prior, name)
            ratio = beside / value if value else None
            yield Figure(f"{name} tilt={tilt}", value, unit, "prior", beside, ratio)
        yield Figure(f"hypotheses per query tilt={tilt}", ours.hypotheses_per_query, "")
        yield Figure(f"seconds per query tilt={tilt}", self.seconds_per_query(tilt), "s")

    def _small_print(self) -> str:
        lines = [
            f"{self.city}, {len(self.of_tilt(TILTS[0]))} views ({self.rejections} draws rejected), "
            f"{self.protocol}; in brackets the 95 % interval."
        ]
        for tilt in TILTS:
            missed = [o for o in self.of_tilt(tilt) if not o.is_found]
            unfound = sum(o.score < o.truth_score for o in missed)
            lines.append(
                f"tilt={tilt}: {len(missed)} not within (2 m, 2 deg); in {unfound} of them the truth fits "
                f"better than the estimate, in {len(missed) - unfound} it does not."
            )
        return "\n".join(lines)


def _cells(name: str, summary: SplitSummary, seconds: str) -> list[str]:
    recalls = []
    for label, percent in summary.recall.items():
        low, high = summary.interval[label]
        recalls.append(f"{percent:.1f} [{low:.1f}, {high:.1f}]")
    answered = f"{summary.hypotheses_per_query:.0f}" if summary.hypotheses_per_query > 0 else "-"
    medians = [f"{summary.median_translation_m:.2f}", f"{summary.median_rotation_deg:.2f}"]
    return [name, *recalls, *medians, answered, seconds]
