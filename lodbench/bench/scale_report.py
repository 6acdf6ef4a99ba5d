"""The figures of a large city as data and as text."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodbench.bench.figures import Figure
from lodbench.bench.opening import Opening
from lodbench.reporting.columns import format_columns


@dataclass(frozen=True, slots=True)
class ScaleTimings:
    """Microseconds per hypothesis on the same views of two cities, one number per view.

    Attributes:
        name: What kind of views.
        core: Of the core alone.
        whole: Of the whole city.
        different: Hypotheses whose counts differ between the two.
    """

    name: str
    core: tuple[float, ...]
    whole: tuple[float, ...]
    different: int

    @property
    def ratio(self) -> float:
        """Returns how many times the core's mean cost the whole city's is."""
        return float(np.mean(self.whole) / np.mean(self.core))


@dataclass(frozen=True, slots=True)
class ScaleReport:
    """What a large city costs beside its core.

    Attributes:
        buildings: Of the large city.
        triangles: Of the large city.
        hypotheses: Around each view.
        horizon_hypotheses: Around each view to the horizon.
        making_s: Seconds to make and store the city and lay it out; to open it, if it was there.
        disk_mb: Its place on disk, scene and engine, megabytes.
        opening: What opening it takes, in a process of its own.
        rejections: Views thrown away: too few or too many buildings, or ground outside the core in sight.
        timings: One per kind of views.
    """

    buildings: int
    triangles: int
    hypotheses: int
    horizon_hypotheses: int
    making_s: float
    disk_mb: float
    opening: Opening
    rejections: int
    timings: tuple[ScaleTimings, ...]

    def figures(self) -> list[Figure]:
        """Returns the costs beside the core's, and what the large city takes."""
        figures = []
        for t in self.timings:
            core, whole = float(np.mean(t.core)), float(np.mean(t.whole))
            title = f"render and IoU, {self.buildings:,} buildings, {t.name}"
            figures.append(Figure(title, whole, "us", "the core alone", core, core / whole))
            figures.append(Figure(f"hypotheses that count differently, {t.name}", t.different, ""))
        figures.append(Figure("opening", self.opening.seconds, "s"))
        if self.opening.resident_mb is not None:
            figures.append(Figure("resident once open", self.opening.resident_mb, "MB"))
        return [
            *figures,
            Figure("on disk", self.disk_mb, "MB"),
            Figure("views rejected", self.rejections, ""),
        ]

    def to_text(self) -> str:
        """Returns the report as a table with small print."""
        rows = [["views", "core us/hypothesis", "whole us/hypothesis", "cost ratio", "count differently"]]
        for t in self.timings:
            rows.append(
                [
                    t.name,
                    f"{np.mean(t.core):.1f}",
                    f"{np.mean(t.whole):.1f}",
                    f"{t.ratio:.2f}",
                    str(t.different),
                ]
            )
        resident = self.opening.resident_mb
        memory = (
            "unknown" if resident is None else f"{resident:,.0f} MB ({self.opening.before_mb:,.0f} before)"
        )
        cities = f"{self.buildings:,} buildings, {self.triangles:,} triangles, beside their first thousand."
        views = (
            f"{len(self.timings[0].core)} views of each kind ({self.rejections} rejected), {self.hypotheses} "
            f"hypotheses around each ({self.horizon_hypotheses} to the horizon), one thread, best pass per "
            "view, the cities in turn."
        )
        taken = (
            f"Opened in {self.opening.seconds:.2f} s, resident then {memory}; {self.disk_mb:,.0f} MB on "
            f"disk; made or found in {self.making_s:.1f} s."
        )
        return "\n".join([format_columns(rows), cities, views, taken])
