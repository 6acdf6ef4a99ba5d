"""Masks measured: overlaps per view, their means and intervals, as figures and as text."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.bench.figures import Figure
from lodbench.evaluation.statistics import Interval, bootstrap_means, bootstrap_ratio
from lodbench.reporting.columns import format_columns


class Overlap(NamedTuple):
    """How far two masks agree, in pixels.

    Attributes:
        shared: In both.
        union: In either.
    """

    shared: int
    union: int

    @property
    def iou(self) -> float:
        """Returns intersection over union; 0 where both are empty."""
        return self.shared / self.union if self.union else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class ViewQuality:
    """One view measured.

    Attributes:
        key: Split and name.
        photo: Its file.
        mask: File of the true mask.
        found: (H, W) mask that the segmenter made.
        with_mask: Agreement with the true mask.
        ceiling: Agreement of the visible part, the best that can be seen, with the true mask; or None.
        with_visible: Agreement with the visible part; or None.
        seconds: CPU time from the file to the mask.
    """

    key: str
    photo: Path
    mask: Path
    found: NDArray[np.bool_]
    with_mask: Overlap
    ceiling: Overlap | None
    with_visible: Overlap | None
    seconds: float


class IouSummary(NamedTuple):
    """Overlaps of many views.

    Attributes:
        mean: Mean of the views' IoUs.
        mean_interval: 95 % interval of it, by bootstrap over views.
        pooled: IoU of all pixels together.
        pooled_interval: Likewise.
    """

    mean: float
    mean_interval: Interval
    pooled: float
    pooled_interval: Interval


@dataclass(frozen=True, slots=True, eq=False)
class MaskQualityReport:
    """What was measured.

    Attributes:
        segmenter: Its name.
        weights: Start of the SHA-256 of its weights, or ``random``.
        data: Name of the set.
        num_views: Views in it.
        least_share: Least share of buildings in the views that count.
        views: Those that count.
        notes: What the segmenter says of itself.
    """

    segmenter: str
    weights: str
    data: str
    num_views: int
    least_share: float
    views: tuple[ViewQuality, ...]
    notes: tuple[str, ...]

    @property
    def seconds(self) -> float:
        """Returns the median CPU time of a photo on one core."""
        return float(np.median([view.seconds for view in self.views]))

    def rows(self) -> list[tuple[str, str, IouSummary]]:
        """Returns per kind of IoU its name in figures, in words, and its numbers."""
        kinds: list[tuple[str, str, Callable[[ViewQuality], Overlap | None]]] = [
            ("mask_iou", "IoU with the mask", lambda view: view.with_mask),
            ("mask_iou_ceiling", "  ceiling: what is visible of it", lambda view: view.ceiling),
            ("visible_iou", "IoU with the visible part", lambda view: view.with_visible),
        ]
        rows = []
        for name, words, of in kinds:
            overlaps = [overlap for view in self.views if (overlap := of(view)) is not None]
            if overlaps:
                rows.append((name, words, summary_of(overlaps)))
        return rows

    def figures(self) -> list[Figure]:
        """Returns mean and pooled IoUs, the number of views, and the time."""
        found = []
        for name, _, summary in self.rows():
            found.append(Figure(f"{name}_mean", summary.mean, ""))
            found.append(Figure(f"{name}_pooled", summary.pooled, ""))
        return [
            *found,
            Figure("views", float(len(self.views)), ""),
            Figure("cpu_seconds_per_photo", self.seconds, "s"),
        ]

    def to_text(self) -> str:
        """Returns a table, the time per photo, and what must be known of the segmenter."""
        cells = [["", "mean per view", "(95 %)", "pooled", "(95 %)"]]
        for _, words, s in self.rows():
            cells.append(
                [
                    words,
                    f"{s.mean:.3f}",
                    _words(s.mean_interval),
                    f"{s.pooled:.3f}",
                    _words(s.pooled_interval),
                ]
            )
        height, width = self.views[0].found.shape
        which = f"{len(self.views)} of the {self.num_views} views of {self.data}"
        return "\n".join(
            [
                f"{self.segmenter}, weights {self.weights}: {which}, "
                f"those with {100 * self.least_share:g} % buildings or more, {width} x {height}",
                format_columns(cells),
                f"{1000 * self.seconds:.0f} ms a photo on one core, from file to mask (median CPU time)",
                *(f"note: {note}" for note in self.notes),
            ]
        )


def summary_of(overlaps: list[Overlap]) -> IouSummary:
    """Returns mean and pooled IoU of some views, with their intervals."""
    ious = np.array([overlap.iou for overlap in overlaps])
    shared, union = np.array(overlaps, dtype=np.float64).T
    return IouSummary(
        mean=float(ious.mean()),
        mean_interval=bootstrap_means(ious[:, None])[0],
        pooled=float(shared.sum() / max(union.sum(), 1.0)),
        pooled_interval=bootstrap_ratio(shared, np.maximum(union, 1.0)),
    )


def _words(interval: Interval) -> str:
    return f"({interval[0]:.3f} to {interval[1]:.3f})"
