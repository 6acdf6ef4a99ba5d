"""Pictures of a stored run's queries for its page: photo, mask, and the city's outlines."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Entry
from lodbench.evaluation.queries import ERROR, has_truth, own_failure
from lodbench.execution import Progress
from lodbench.geometry import Pose
from lodbench.harness.runs.prepare import prior_of
from lodbench.harness.runs.verify import Verdict
from lodbench.rendering import Renderer, make_renderer
from lodbench.reporting.answers import percent_text, trust_of
from lodbench.reporting.doubts import why_of
from lodbench.reporting.overlays import OverlayInput, draw_overlay, jpeg_bytes
from lodbench.reporting.page import Picture

if TYPE_CHECKING:
    import pandas as pd

# Of more queries than this the page shows the worst and the best, half of it each: a picture has 60 kB.
MAX_PICTURES = 240


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
    drawn = draw_overlay(_shown(verdict, renderer.scene, tilt, entry), renderer)
    row = verdict.stored.queries.loc[[entry.key]].iloc[0]
    return Picture(jpeg_bytes(drawn), "jpeg", _caption(verdict, row), "", entry.key)


def _ordered(queries: pd.DataFrame) -> pd.DataFrame:
    """Returns the queries, worst first: by error where there is a truth, else by probability or score."""
    if has_truth(queries).any():
        return queries.sort_values([*ERROR, "query"], ascending=[False, False, True], na_position="last")
    by = "probability" if queries["probability"].notna().any() else "score"
    return queries.sort_values([by, "query"], na_position="first")


def _shown(verdict: Verdict, scene: Scene, tilt: str, entry: Entry) -> OverlayInput:
    assert verdict.dataset is not None  # noqa: S101 - there are entries
    assert entry.camera is not None  # noqa: S101 - the caller has looked
    found = verdict.stored.predictions.get(entry.key)

    def local(pose: Pose | None) -> Pose | None:
        return None if pose is None else pose.shifted(-np.asarray(scene.origin))

    return OverlayInput(
        camera=entry.camera,
        mask=None if found is None else found.mask,
        image=entry.image,
        prior=local(prior_of(entry, verdict.dataset, tilt)),
        estimate=local(verdict.stored.poses.get(entry.key)),
        truth=local(verdict.dataset.truth.get(entry.key)),
        caption=entry.key,
    )


def _caption(verdict: Verdict, row: pd.Series[Any]) -> str:
    found = verdict.stored.predictions.get(str(row.name))
    if found is None or found.pose is None:
        return f"{row.name}: {own_failure(row['failure'])}"
    metres, degrees = row[list(ERROR)]
    words = [] if math.isnan(metres) else [f"{metres:.2f} m, {degrees:.2f} deg"]
    words += [] if math.isnan(row["score"]) else [f"score {row['score']:.3f}"]
    if found.probability is not None:
        words.append(f"probability {percent_text(found.probability)}")
    if trust_of(found) != "-":
        words.append(trust_of(found))
    return f"{row.name}: {'; '.join([', '.join(words), *why_of(found)])}"
