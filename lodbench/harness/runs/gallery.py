"""The overlays of scored poses: the worst and the best queries."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Entry
from lodbench.errors import STOPPED
from lodbench.evaluation.predictions import Prediction
from lodbench.evaluation.queries import ERROR, PRIOR_ERROR, has_truth, is_answered
from lodbench.execution.same_folder import staying_here
from lodbench.harness.runs.predict import PREDICTIONS_FILE
from lodbench.harness.runs.prepare import Preparation
from lodbench.harness.runs.result import Result
from lodbench.plugins import blaming
from lodbench.rendering import Renderer
from lodbench.reporting.overlays import OverlayInput, draw_overlay, write_picture
from lodbench.segmentation import Segmenter, binary_mask, check_mask
from lodbench.storage import make_folder, remove_leftovers
from lodbench.storage.disk import disk

if TYPE_CHECKING:
    import pandas as pd

# Pictures of each kind and split.
COUNT = 3
# What the first and the last queries are called: by error, and without a truth by probability or score.
_ENDS = {
    "translation_error_m": ("best", "worst"),
    "probability": ("most_probable", "least_probable"),
    "score": ("highest_score", "lowest_score"),
}
_NAMES = "|".join(name for ends in _ENDS.values() for name in ends)


def write_overlays(
    result: Result, preparation: Preparation, renderer: Callable[[], Renderer], was_written: bool = False
) -> list[Path]:
    """Writes pictures of the worst and best queries of each split, removes others; returns their files.

    Args:
        result: What was found.
        preparation: Makes queries of its entries.
        renderer: Returns who draws; called once a picture is drawn.
        was_written: The folder has these very results from before: its pictures that are newer than the
            answers, the photos and the code that draws stay.
    """
    folder = result.folder / "overlays"
    make_folder(folder)
    remove_leftovers(folder)
    entries = {entry.key: entry for entry in result.dataset.entries}
    written: list[Path] = []
    sources = [result.folder / PREDICTIONS_FILE, *_code_of_pictures()] if was_written else []
    for split in result.splits:
        for kind, chosen in chosen_queries(result.queries, split).items():
            for rank, (key, row) in enumerate(chosen.iterrows(), start=1):
                entry = entries[str(key)]
                # A camera that cannot be drawn is that query's fault already.
                if entry.camera is None or entry.camera.distortion:
                    continue
                path = folder / overlay_name(split, kind, rank, entry.name)
                written.append(path)
                if was_written and _is_newer(path, [*sources, entry.image, entry.mask]):
                    continue
                shown = _shown(preparation, entry, row, result.predictions[entry.key])
                drawer = renderer()
                with blaming("renderers", drawer.name, "draw"):
                    picture = draw_overlay(shown, drawer)
                write_picture(path, picture)
    # A query asked again has another place among the best and the worst: its old picture is wrong.
    for path in sorted(folder.glob("*.png")):
        if path not in written and re.search(rf"_({_NAMES})_\d+_", path.name):
            disk().remove(path)
    return written


def _code_of_pictures() -> list[Path]:
    """Returns the files that pictures depend on and the digest in a run folder's name does not."""
    package = Path(__file__).parents[2]
    return [file for part in ("evaluation", "reporting") for file in (package / part).glob("*.py")]


def _is_newer(path: Path, others: Sequence[Path | None]) -> bool:
    """Tells whether a file is there, and was written after the others that are there."""
    try:
        written = path.stat().st_mtime_ns
        return all(other.stat().st_mtime_ns < written for other in others if other is not None)
    except FileNotFoundError:
        return False


def chosen_queries(queries: pd.DataFrame, split: str) -> dict[str, pd.DataFrame]:
    """Returns the first and the last queries of a split, most extreme first; no query is both.

    By error they are called ``best`` and ``worst``; without a truth they are the ``most_probable`` and
    ``least_probable``, or of a method that gives no probability those of ``highest_score`` and
    ``lowest_score``.
    """
    mine = queries[queries["split"] == split]
    by = "translation_error_m"
    if has_truth(mine).any():
        mine = mine[has_truth(mine)].sort_values([by, "query"])
    else:
        mine = mine[is_answered(mine)]
        by = "probability" if mine["probability"].notna().any() else "score"
        mine = mine.sort_values([by, "query"], ascending=[False, True])
    first, last = _ENDS[by]
    return {first: mine[:COUNT], last: mine[max(COUNT, len(mine) - COUNT) :][::-1]}


def overlay_name(split: str, kind: str, rank: int, name: str) -> str:
    """Returns the file name of an overlay."""
    return re.sub(r"[^\w.-]+", "_", f"{split}_{kind}_{rank}_{Path(name).stem}") + ".png"


def _shown(
    preparation: Preparation, entry: Entry, row: pd.Series[Any], prediction: Prediction
) -> OverlayInput:
    assert entry.camera is not None  # noqa: S101 - the caller has looked
    prior, truth = preparation.prior(entry), preparation.dataset.truth.get(entry.key)
    return OverlayInput(
        camera=entry.camera,
        mask=_mask(preparation.segmenter, entry, prediction),
        image=entry.image,
        prior=None if prior is None else preparation.local(prior),
        estimate=None if prediction.pose is None else preparation.local(prediction.pose),
        truth=None if truth is None else preparation.local(truth),
        caption=_caption(row, prediction.pose is not None),
    )


@staying_here()
def _mask(segmenter: Segmenter, entry: Entry, prediction: Prediction) -> NDArray[np.bool_] | None:
    """Returns the mask that was used; for a pose made elsewhere the dataset's own, where it has one.

    Args:
        segmenter: Asked where none is stored.
        entry: Of a query with a camera.
        prediction: The query's.
    """
    if prediction.mask is not None:
        return prediction.mask
    assert entry.camera is not None  # noqa: S101 - the caller has looked
    try:
        probability = check_mask(segmenter.segment(entry), entry.camera)
    except STOPPED:
        raise
    except BaseException:  # its query's row has the reason; a picture must not end a run
        return None
    return binary_mask(probability, probability.shape[1], probability.shape[0])


def _caption(row: pd.Series[Any], is_answered: bool) -> str:
    if not is_answered:
        return f"{row.name}: {row['failure']}"
    score = "" if math.isnan(row["score"]) else f", score {row['score']:.3f}"
    errors = row[[*ERROR, *PRIOR_ERROR]]
    if errors.isna().any():
        return f"{row.name}{score}"
    metres, degrees, prior_m, prior_deg = errors
    return (
        f"{row.name}: {metres:.2f} m, {degrees:.2f} deg{score} (prior {prior_m:.1f} m, {prior_deg:.1f} deg)"
    )
