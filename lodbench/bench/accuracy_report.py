"""The accuracy figures as data and as text: recalls and medians of methods beside their priors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.bench.figures import Figure
from lodbench.evaluation import DEFAULT_THRESHOLDS, SplitSummary
from lodbench.evaluation.calibration import Calibration, calibrate
from lodbench.evaluation.queries import ERROR, summarize_queries
from lodbench.evaluation.recall import PROBABILITY_THRESHOLD, hits_of
from lodbench.reporting.columns import format_columns
from lodbench.reporting.table_columns import finite_text

if TYPE_CHECKING:
    import pandas as pd

SPLIT = "all"

# The two blocks: pitch and roll of the prior true, or drawn with an error.
TILTS = ("truth", "prior")


@dataclass(frozen=True, slots=True, eq=False)
class AccuracyReport:
    """What every method made of every view under both tilts.

    Attributes:
        city: File name of the city model.
        methods: Names of the methods.
        protocol: What was drawn, in words.
        rejections: Draws of a view thrown away: too few or too many buildings, or among them.
        queries: One row per seed, method, tilt and view, as ``lodbench.evaluation.queries`` has them, with
            the columns ``method``, ``seed`` and ``seconds``. A ``score`` below ``mask_iou``, what the true
            pose would score, is a failure of the search; a higher one says that the mask fits a wrong pose
            better.
    """

    city: str
    methods: tuple[str, ...]
    protocol: str
    rejections: int
    queries: pd.DataFrame

    def of_tilt(self, tilt: str, method: str | None = None) -> pd.DataFrame:
        """Returns the rows of ``truth`` or ``prior``, of a method; the first if None."""
        is_of = (self.queries["tilt"] == tilt) & (self.queries["method"] == (method or self.methods[0]))
        return self.queries[is_of]

    def summary(self, tilt: str, method: str | None = None) -> SplitSummary:
        """Returns a method's recalls and medians under a tilt."""
        return summarize_queries(self.of_tilt(tilt, method), SPLIT)[0]

    def prior_summary(self, tilt: str) -> SplitSummary:
        """Returns the same of the priors themselves."""
        return summarize_queries(self.of_tilt(tilt), SPLIT)[1]

    def seconds_per_query(self, tilt: str, method: str | None = None) -> float:
        """Returns the mean wall time of a query."""
        return float(self.of_tilt(tilt, method)["seconds"].mean())

    def calibrations(self) -> dict[str, Calibration]:
        """Returns the calibrations there are, by method and tilt in words."""
        found = {}
        for method, tilt in self._blocks():
            rows = self.of_tilt(tilt, method)
            if rows["probability"].notna().any():
                confidence = rows["probability"].fillna(0.0).to_numpy()
                found[f"{method}, tilt={tilt}"] = calibrate(confidence, _is_found(rows))
        return found

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
            "ece %",
            "aurc %",
        ]
        rows = [head]
        for tilt in TILTS:
            rows.append([*_cells(f"tilt={tilt}  prior", self.prior_summary(tilt), "-"), "-", "-"])
            for method in self.methods:
                seconds = f"{self.seconds_per_query(tilt, method):.2f}"
                cells = _cells(f"tilt={tilt}  {method}", self.summary(tilt, method), seconds)
                rows.append([*cells, *_knowing(self.summary(tilt, method))])
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
        if "ece_percent" in ours.to_json()["metrics"]:
            yield Figure(f"calibration error {block}", ours.metrics["ece_percent"], "%")
            yield Figure(f"area under risk over coverage {block}", ours.metrics["aurc_percent"], "%")

    def _small_print(self) -> str:
        views = len(self.of_tilt(TILTS[0]))
        lines = [
            f"{self.city}, {views} views ({self.rejections} draws rejected), "
            f"{self.protocol}; in brackets the 95 % interval."
        ]
        for method, tilt in self._blocks():
            rows = self.of_tilt(tilt, method)
            missed = rows[~_is_found(rows)]
            unfound = int((missed["score"].fillna(0.0) < missed["mask_iou"]).sum())
            whose = f"tilt={tilt}" if len(self.methods) == 1 else f"tilt={tilt} {method}"
            lines.append(
                f"{whose}: {len(missed)} not within (2 m, 2 deg); in {unfound} of them the truth fits "
                f"better than the estimate, in {len(missed) - unfound} it does not."
            )
        if self.calibrations():
            lines.append(
                "ece: expected calibration error, mean distance of the probability a method gives of being "
                "within (2 m, 2 deg) from the share it found; aurc: area under the risk-coverage curve, the "
                "share not found as the surest 0 to 100 % are answered, averaged."
            )
        return "\n".join(lines)


def _is_found(rows: pd.DataFrame) -> NDArray[np.bool_]:
    return hits_of(rows[list(ERROR)].to_numpy(), PROBABILITY_THRESHOLD)


def _knowing(summary: SplitSummary) -> list[str]:
    numbers = (("ece_percent", ".1f"), ("aurc_percent", ".2f"))
    return [finite_text(summary.metrics[name], spec) for name, spec in numbers]


def _cells(name: str, summary: SplitSummary, seconds: str) -> list[str]:
    recalls = []
    for label, percent in summary.recall.items():
        low, high = summary.interval[label]
        recalls.append(f"{percent:.1f} [{low:.1f}, {high:.1f}]")
    answered = f"{summary.hypotheses_per_query:.0f}" if summary.hypotheses_per_query > 0 else "-"
    medians = [f"{summary.median_translation_m:.2f}", f"{summary.median_rotation_deg:.2f}"]
    return [name, *recalls, *medians, answered, seconds]
