"""Masks measured: overlaps per view, their means and intervals, as figures and as text."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lodbench.bench.figures import Figure, Report
from lodbench.bench.mask_pictures import draw_sheet
from lodbench.evaluation.statistics import Interval, bootstrap_means, bootstrap_ratio
from lodbench.reporting.aligned_text import format_columns

if TYPE_CHECKING:
    import pandas as pd

# Kinds of overlaps by the name of their columns; their names in figures, and in words.
KINDS = {
    "mask": ("mask_iou", "IoU with the mask"),
    "ceiling": ("mask_iou_ceiling", "  ceiling: what is visible of it"),
    "visible": ("visible_iou", "IoU with the visible part"),
}


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


def report_masks(views: pd.DataFrame, which: str, segmenter: str, notes: Sequence[str]) -> Report:
    """Returns the report of views: a table, the time per photo, and what must be known of the segmenter.

    Args:
        views: A row per view: ``key`` (split and name), ``photo`` and ``mask`` (their files), ``found``
            ((H, W) bool, what the segmenter made), ``seconds`` (CPU time from the file to the mask), and for
            each kind of ``KINDS`` there is its ``shared`` and ``union``, pixels in both masks and in either.
        which: Views and their data in words.
        segmenter: Its name.
        notes: What the segmenter says of itself.
    """
    summaries = {kind: summary_of(views, kind) for kind in KINDS if f"{kind} shared" in views}
    seconds = float(views["seconds"].median())
    cells = [["", "mean per view", "(95 %)", "pooled", "(95 %)"]]
    figures = []
    for kind, s in summaries.items():
        name, words = KINDS[kind]
        figures += [Figure(f"{name}_mean", s.mean, ""), Figure(f"{name}_pooled", s.pooled, "")]
        mean, pooled = f"{s.mean:.3f}", f"{s.pooled:.3f}"
        cells.append([words, mean, in_words(s.mean_interval), pooled, in_words(s.pooled_interval)])
    figures += [Figure("views", float(len(views)), ""), Figure("cpu_seconds_per_photo", seconds, "s")]
    time = f"{1000 * seconds:.0f} ms a photo on one core, from file to mask (median CPU time)"
    text = "\n".join([which, format_columns(cells), time, *(f"note: {note}" for note in notes)])
    return Report(text, figures, views, partial(draw_sheet, views, f"{segmenter} on {len(views)} views"))


def summary_of(views: pd.DataFrame, kind: str) -> IouSummary:
    """Returns mean and pooled IoU of some views, of a kind of overlap, with their intervals."""
    shared, union = (views[f"{kind} {part}"].to_numpy(np.float64) for part in ("shared", "union"))
    union = np.maximum(union, 1.0)
    ious = shared / union
    return IouSummary(
        mean=float(ious.mean()),
        mean_interval=bootstrap_means(ious[:, None])[0],
        pooled=float(shared.sum() / union.sum()),
        pooled_interval=bootstrap_ratio(shared, union),
    )


def in_words(interval: Interval) -> str:
    """Returns ``(0.881 to 0.902)``."""
    return f"({interval[0]:.3f} to {interval[1]:.3f})"
