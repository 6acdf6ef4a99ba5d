"""The overlays of a run: its worst and its best queries."""

from __future__ import annotations

import math
import re
from pathlib import Path

from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault
from lodbench.evaluation.rows import QueryRow
from lodbench.harness.run import Run
from lodbench.reporting.overlays import OverlayInput, draw_overlay, write_picture
from lodbench.segmentation import binary_mask


def write_overlays(run: Run, count: int = 3) -> list[Path]:
    """Writes pictures of the ``count`` worst and best queries of each split; returns their files."""
    folder = run.folder / "overlays"
    folder.mkdir(exist_ok=True)
    entries = {entry.key: entry for entry in run.dataset.entries}
    written = []
    for split in run.splits:
        rows = [row for row in run.rows if row.split == split and row.error is not None]
        rows.sort(key=lambda row: (_translation(row), row.name))
        best, worst = rows[:count], rows[max(count, len(rows) - count) :][::-1]
        for kind, chosen in (("best", best), ("worst", worst)):
            for rank, row in enumerate(chosen, start=1):
                entry = entries[row.key]
                # A camera that cannot be drawn is that query's fault already.
                if entry.camera is None or entry.camera.distortion:
                    continue
                path = folder / f"{_file_name(f'{split}_{kind}_{rank}_{Path(row.name).stem}')}.png"
                write_picture(path, draw_overlay(_shown(run, entry, row), run.scorer))
                written.append(path)
    return written


def _translation(row: QueryRow) -> float:
    return math.inf if row.error is None else row.error.translation_m


def _shown(run: Run, entry: Entry, row: QueryRow) -> OverlayInput:
    assert entry.camera is not None  # noqa: S101 - the caller has looked
    preparation = run.preparation
    try:
        probability = preparation.segmenter.segment(entry)
        mask = binary_mask(probability, probability.shape[1], probability.shape[0])
    except QueryFault:
        mask = None
    prior, truth = preparation.prior(entry), run.dataset.truth.get(entry.key)
    return OverlayInput(
        camera=entry.camera,
        mask=mask,
        image=entry.image,
        prior=None if prior is None else preparation.local(prior),
        estimate=None if row.pose is None else preparation.local(row.pose),
        truth=None if truth is None else preparation.local(truth),
        caption=_caption(row),
    )


def _caption(row: QueryRow) -> str:
    if row.failure:
        return f"{row.key}: {row.failure}"
    error, prior = row.error, row.prior_error
    score = "" if row.score is None else f", score {row.score:.3f}"
    if error is None or prior is None:
        return f"{row.key}{score}"
    return (
        f"{row.key}: {error.translation_m:.2f} m, {error.rotation_deg:.2f} deg{score}"
        f" (prior {prior.translation_m:.1f} m, {prior.rotation_deg:.1f} deg)"
    )


def _file_name(text: str) -> str:
    return re.sub(r"[^\w.-]+", "_", text)
