"""Pictures of scored queries: overlays of the worst and the best, and those of a run's page."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Entry
from lodbench.errors import STOPPED
from lodbench.evaluation.metrics import ERROR, PRIOR_ERROR, has_truth, is_answered, own_failure
from lodbench.evaluation.predictions import Prediction
from lodbench.execution import Progress
from lodbench.execution.processes import staying_here
from lodbench.geometry import Pose
from lodbench.harness.runs import artefacts, predict
from lodbench.harness.runs.queries import Preparation, prior_of
from lodbench.harness.runs.verify import Verdict
from lodbench.plugins import blaming
from lodbench.rendering import Renderer, make_renderer
from lodbench.reporting import answers, overlays
from lodbench.reporting.page import Picture
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
# Of more queries than this the page shows the worst and the best, half of it each: a picture has 60 kB.
MAX_PICTURES = 240


def write_overlays(
    result: artefacts.Result,
    preparation: Preparation,
    renderer: Callable[[], Renderer],
    was_written: bool = False,
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
    sources = [result.folder / predict.PREDICTIONS_FILE, *_code_of_pictures()] if was_written else []
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
                    picture = overlays.draw_overlay(shown, drawer)
                overlays.write_picture(path, picture)
    # A query tried again has another place among the best and the worst: its old picture is wrong.
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
) -> overlays.OverlayInput:
    assert entry.camera is not None  # noqa: S101 - the caller has looked
    prior, truth = preparation.prior(entry), preparation.dataset.truth.get(entry.key)
    return overlays.OverlayInput(
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


def query_pictures(verdict: Verdict, scene: Scene, tilt: str) -> list[Picture]:
    """Returns a picture of each query, the worst first; of a large run those at both ends."""
    queries = _ordered(verdict.stored.queries)
    if len(queries) > MAX_PICTURES:
        half = MAX_PICTURES // 2
        queries = queries.iloc[[*range(half), *range(len(queries) - half, len(queries))]]
    entries = {entry.key: entry for entry in verdict.entries}
    renderer = make_renderer("silhouette", scene)
    pictures = []
    with Progress("pictures", len(queries)) as progress:
        for key in queries.index:
            entry = entries.get(str(key))
            picture = None if entry is None else picture_of(verdict, renderer, tilt, entry)
            pictures += [] if picture is None else [picture]
            progress.advance()
    return pictures


def picture_of(verdict: Verdict, renderer: Renderer, tilt: str, entry: Entry) -> Picture | None:
    """Returns the picture of a query; None where its camera cannot be drawn, which is its own fault."""
    if entry.camera is None or entry.camera.distortion:
        return None
    drawn = overlays.draw_overlay(_shown_picture(verdict, renderer.scene, tilt, entry), renderer)
    row = verdict.stored.queries.loc[[entry.key]].iloc[0]
    return Picture(overlays.jpeg_bytes(drawn), "jpeg", _place_caption(verdict, row), "", entry.key)


def _ordered(queries: pd.DataFrame) -> pd.DataFrame:
    """Returns the queries, worst first: by error where there is a truth, else by probability or score."""
    if has_truth(queries).any():
        return queries.sort_values([*ERROR, "query"], ascending=[False, False, True], na_position="last")
    by = "probability" if queries["probability"].notna().any() else "score"
    return queries.sort_values([by, "query"], na_position="first")


def _shown_picture(verdict: Verdict, scene: Scene, tilt: str, entry: Entry) -> overlays.OverlayInput:
    assert verdict.dataset is not None  # noqa: S101 - there are entries
    assert entry.camera is not None  # noqa: S101 - the caller has looked
    prediction = verdict.stored.predictions.get(entry.key)

    def local(pose: Pose | None) -> Pose | None:
        return None if pose is None else pose.shifted(-np.asarray(scene.origin))

    return overlays.OverlayInput(
        camera=entry.camera,
        mask=None if prediction is None else prediction.mask,
        image=entry.image,
        prior=local(prior_of(entry, verdict.dataset, tilt)),
        estimate=local(verdict.stored.poses.get(entry.key)),
        truth=local(verdict.dataset.truth.get(entry.key)),
        caption=entry.key,
    )


def _place_caption(verdict: Verdict, row: pd.Series[Any]) -> str:
    prediction = verdict.stored.predictions.get(str(row.name))
    if prediction is None or prediction.pose is None:
        return f"{row.name}: {own_failure(row['failure'])}"
    metres, degrees = row[list(ERROR)]
    words = [] if math.isnan(metres) else [f"{metres:.2f} m, {degrees:.2f} deg"]
    words += [] if math.isnan(row["score"]) else [f"score {row['score']:.3f}"]
    if prediction.probability is not None:
        words.append(f"probability {answers.percent_text(prediction.probability)}")
    if answers.trust_label(prediction) != "-":
        words.append(answers.trust_label(prediction))
    return f"{row.name}: {'; '.join([', '.join(words), *answers.why_of(prediction)])}"
