"""The overlays of scored poses: the worst and the best queries."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault
from lodbench.evaluation.predictions import Prediction
from lodbench.evaluation.rows import QueryRow
from lodbench.harness.runs.prepare import Preparation
from lodbench.harness.runs.result import Result
from lodbench.rendering import Renderer
from lodbench.reporting.overlays import OverlayInput, draw_overlay, write_picture
from lodbench.segmentation import Segmenter, binary_mask

# Pictures of each kind and split.
COUNT = 3


def write_overlays(result: Result, preparation: Preparation, renderer: Renderer) -> list[Path]:
    """Writes pictures of the worst and best queries of each split; returns their files."""
    folder = result.folder / "overlays"
    folder.mkdir(exist_ok=True)
    entries = {entry.key: entry for entry in result.dataset.entries}
    written = []
    for split in result.splits:
        for kind, chosen in chosen_rows(result.rows, split).items():
            for rank, row in enumerate(chosen, start=1):
                entry = entries[row.key]
                # A camera that cannot be drawn is that query's fault already.
                if entry.camera is None or entry.camera.distortion:
                    continue
                path = folder / overlay_name(split, kind, rank, row.name)
                shown = _shown(preparation, entry, row, result.predictions[row.key])
                write_picture(path, draw_overlay(shown, renderer))
                written.append(path)
    return written


def chosen_rows(rows: Sequence[QueryRow], split: str, count: int = COUNT) -> dict[str, list[QueryRow]]:
    """Returns the ``best`` and the ``worst`` queries of a split, most extreme first; no query is both."""
    all_of_split = [row for row in rows if row.split == split]
    # Without a truth the method's own score has to do.
    mine = [row for row in all_of_split if row.error is not None]
    mine = mine or [row for row in all_of_split if row.is_answered]
    mine.sort(key=lambda row: (_badness(row), row.name))
    return {"best": mine[:count], "worst": mine[max(count, len(mine) - count) :][::-1]}


def overlay_name(split: str, kind: str, rank: int, name: str) -> str:
    """Returns the file name of an overlay."""
    return re.sub(r"[^\w.-]+", "_", f"{split}_{kind}_{rank}_{Path(name).stem}") + ".png"


def _badness(row: QueryRow) -> float:
    if row.error is not None:
        return row.error.translation_m
    return math.inf if row.score is None else -row.score


def _shown(preparation: Preparation, entry: Entry, row: QueryRow, prediction: Prediction) -> OverlayInput:
    assert entry.camera is not None  # noqa: S101 - the caller has looked
    prior, truth = preparation.prior(entry), preparation.dataset.truth.get(entry.key)
    return OverlayInput(
        camera=entry.camera,
        mask=_mask(preparation.segmenter, entry, prediction),
        image=entry.image,
        prior=None if prior is None else preparation.local(prior),
        estimate=None if row.pose is None else preparation.local(row.pose),
        truth=None if truth is None else preparation.local(truth),
        caption=_caption(row),
    )


def _mask(segmenter: Segmenter, entry: Entry, prediction: Prediction) -> NDArray[np.bool_] | None:
    """Returns the mask that was used; for a pose made elsewhere the dataset's own, where it has one."""
    if prediction.mask is not None:
        return prediction.mask
    try:
        probability = segmenter.segment(entry)
    except QueryFault:
        return None
    return binary_mask(probability, probability.shape[1], probability.shape[0])


def _caption(row: QueryRow) -> str:
    if row.failure and not row.is_answered:
        return f"{row.key}: {row.failure}"
    error, prior = row.error, row.prior_error
    score = "" if row.score is None else f", score {row.score:.3f}"
    if error is None or prior is None:
        return f"{row.key}{score}"
    return (
        f"{row.key}: {error.translation_m:.2f} m, {error.rotation_deg:.2f} deg{score}"
        f" (prior {prior.translation_m:.1f} m, {prior.rotation_deg:.1f} deg)"
    )
