"""One HTML page of a finished run: tables, figures, galleries and every query, all inside one file."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.errors import LodbenchError
from lodbench.evaluation.calibration import calibrate
from lodbench.evaluation.queries import ERROR, PARTS, PRIOR_ERROR, has_truth, of_split
from lodbench.evaluation.recall import PROBABILITY_THRESHOLD, hits_of
from lodbench.harness.city import open_city
from lodbench.harness.runs.gallery import chosen_queries, overlay_name
from lodbench.harness.runs.predict import open_predictions
from lodbench.harness.runs.prepare import prior_of
from lodbench.harness.runs.verify import Verdict
from lodbench.reporting.calibration_figures import draw_calibration
from lodbench.reporting.page import Picture, facts, markup, rendered
from lodbench.reporting.run_figures import (
    ErrorSample,
    Places,
    Trace,
    draw_error_curves,
    draw_top_view,
    draw_traces,
)
from lodbench.reporting.summaries import with_seconds
from lodbench.reporting.table_formats import format_html
from lodbench.reporting.tables import tables_of

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]
# JPEG quality of the pictures inside the page: outlines stay sharp, a picture weighs about 60 kB.
_QUALITY = 82
# Head, column and format of the table of every query; texts have no format.
_QUERY_COLUMNS = (
    ("query", "query", ""), ("split", "split", ""), ("m", ERROR[0], ".2f"), ("deg", ERROR[1], ".2f"),
    ("along the ground m", PARTS[0], ".2f"), ("up m", PARTS[1], ".2f"), ("yaw deg", PARTS[2], ".2f"),
    ("prior m", PRIOR_ERROR[0], ".2f"), ("prior deg", PRIOR_ERROR[1], ".2f"), ("score", "score", ".3f"),
    ("mask IoU", "mask_iou", ".3f"), ("hypotheses", "hypotheses", ".0f"), ("failure", "failure", ""),
)  # fmt: skip


def run_report(verdict: Verdict, tilt: str) -> str:
    """Returns the page of a run that has been verified.

    Args:
        verdict: The run, what verifying it found, and its dataset where that is there.
        tilt: The run's ``tilt``: which prior it had.
    """
    stored = verdict.stored
    summary = with_seconds(stored.summary, stored.provenance.get("seconds_per_query", {}))
    splits = tuple(summary["splits"])
    (table,) = tables_of([summary])
    more = {
        "intervals": "Recall with 95 % intervals",
        "details": "Areas under recall, parts of the error, cost",
        "calibration": "Probability of being within (2 m, 2 deg): its mean, ECE and AURC, percent",
    }
    if "ece_percent" not in table.numbers():
        del more["calibration"]
    tables = [table, *(replace(table.with_columns(key), title=title) for key, title in more.items())]
    name = " ".join(filter(None, [summary["method"]["name"], summary["method"]["variant"]]))
    sections = [
        ("tables", "Recall", "".join(map(format_html, tables)), []),
        ("errors", "Errors", "", _error_curves(stored.queries, splits)),
        ("calibration", "How sure it was", "", _calibration(stored.queries, splits)),
        ("places", "From above", "", _top_views(verdict, splits, tilt)),
        ("worst", "Worst queries", "", _gallery(stored.folder, stored.queries, splits, "worst")),
        ("best", "Best queries", "", _gallery(stored.folder, stored.queries, splits, "best")),
        ("traces", "How the score rose", "", _traces(stored.folder, stored.queries, splits)),
        ("queries", "Every query", _query_table(stored.queries), []),
        ("provenance", "Where it comes from", _provenance(verdict), []),
    ]
    dataset = f"{summary['dataset']['name']} {summary['dataset']['version']}".strip()
    return rendered(
        "run.html.jinja",
        title=f"{name} on {dataset}",
        differences=verdict.differences,
        is_weak=verdict.is_weak,
        has_truth=has_truth(stored.queries).any(),
        protocol=facts(summary["protocol"]),
        sections=[
            (key, title, markup(html), pictures)
            for key, title, html, pictures in sections
            if html or pictures
        ],
    )


def _query_table(queries: pd.DataFrame) -> str:
    """Returns one line per query, sortable by every column."""

    def number(value: float, spec: str) -> str:
        # Adding 0 turns the -0.00 of a rounded small number into 0.00.
        return format(round(value, int(spec[1])) + 0.0, spec)

    rows = queries.to_dict("records")
    return rendered(
        "queries.html.jinja", rows=rows, columns=_QUERY_COLUMNS, isfinite=math.isfinite, number=number
    )


def _error_curves(queries: pd.DataFrame, splits: Sequence[str]) -> list[Picture]:
    samples = []
    for split in splits:
        mine = of_split(queries, split)
        if len(mine):
            samples.append(
                ErrorSample(split, mine[list(ERROR)].to_numpy(), mine[list(PRIOR_ERROR)].to_numpy())
            )
    if not samples:
        return []
    caption = "Share of all queries below an error; a failed query is never below."
    return [Picture(draw_error_curves(samples)["svg"], "svg+xml", caption, "chart")]


def _calibration(queries: pd.DataFrame, splits: Sequence[str]) -> list[Picture]:
    """Returns reliability and risk over coverage by split; none where the method gave no probability."""
    curves = {}
    for split in splits:
        mine = of_split(queries, split)
        if mine["probability"].notna().any():
            found = hits_of(mine[list(ERROR)].to_numpy(), PROBABILITY_THRESHOLD)
            curves[split] = calibrate(mine["probability"].fillna(0.0).to_numpy(), found)
    if not curves:
        return []
    caption = "Left: confidence and share found; right: what is wrong of the answers let in, surest first."
    return [Picture(draw_calibration(curves)["svg"], "svg+xml", caption, "chart")]


def _top_views(verdict: Verdict, splits: Sequence[str], tilt: str) -> list[Picture]:
    if verdict.dataset is None:
        return []
    scene = _scene(verdict)
    ground, triangles = None, None
    if scene is not None:
        ground, triangles = scene.vertices[:, :2] + scene.origin[:2], scene.triangles
    parts = []
    for split in splits:
        places = _places(verdict, split, tilt)
        if np.isfinite(places.truths).any():
            caption = f"{split}: from each truth a line to its prior and to its estimate."
            parts.append(Picture(draw_top_view(places, ground, triangles)["png"], "png", caption, "chart"))
    return parts


def _scene(verdict: Verdict) -> Scene | None:
    """Returns the city, or None: the page can do without."""
    dataset = verdict.dataset
    if dataset is None or dataset.city_model is None:
        return None
    try:
        return open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height).scene
    except LodbenchError:
        return None


def _places(verdict: Verdict, split: str, tilt: str) -> Places:
    assert verdict.dataset is not None  # noqa: S101 - the caller has looked
    columns: list[list[Floats]] = [[], [], []]
    for entry in verdict.entries:
        if entry.split == split:
            prior = prior_of(entry, verdict.dataset, tilt)
            for column, pose in zip(
                columns,
                (prior, verdict.stored.poses.get(entry.key), verdict.dataset.truth.get(entry.key)),
                strict=True,
            ):
                column.append(np.full(2, np.nan) if pose is None else pose.center[:2])
    return Places(*(np.array(column).reshape(-1, 2) for column in columns))


def _gallery(folder: Path, queries: pd.DataFrame, splits: Sequence[str], kind: str) -> list[Picture]:
    """Returns the overlays that the run left, as far as they are there."""
    figures = []
    for split in splits:
        for rank, (_, row) in enumerate(chosen_queries(queries, split)[kind].iterrows(), start=1):
            path = folder / "overlays" / overlay_name(split, kind, rank, row["query"])
            content = _jpeg(path)
            if content is not None:
                figures.append(Picture(content, "jpeg", _caption(row)))
    return figures


def _jpeg(path: Path) -> bytes | None:
    import cv2

    image = cv2.imread(str(path)) if path.is_file() else None
    if image is None:
        return None
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())


def _caption(row: pd.Series[Any]) -> str:
    metres, degrees = row[list(ERROR)]
    return f"{row.name}: {row['failure'] or f'{metres:.2f} m, {degrees:.2f} deg'}"


def _traces(folder: Path, queries: pd.DataFrame, splits: Sequence[str]) -> list[Picture]:
    """Returns the score traces of the gallery's queries, from the run's predictions."""
    stored = open_predictions(folder, read_only=True)
    traces = []
    for split in splits:
        chosen = chosen_queries(queries, split)
        for kind in ("worst", "best"):
            for key in chosen[kind].index:
                stages = stored[key].get("trace", {}) if key in stored else {}
                if any(len(scores) > 1 for scores in stages.values()):
                    traces.append(Trace(f"{kind}: {key}", {k: tuple(v) for k, v in stages.items()}))
    if not traces:
        return []
    caption = "Best score after each step: every beam, and the best of them."
    return [Picture(draw_traces(traces)["svg"], "svg+xml", caption, "chart")]


def _provenance(verdict: Verdict) -> str:
    stored = verdict.stored
    hidden = {"files", "city_model", "dataset_root", "seconds_per_query"}
    known = stored.provenance.items()
    shown = {key: value for key, value in known if key not in hidden and value is not None}
    shown["run"] = stored.folder.resolve().name
    inputs = stored.summary["dataset"].items()
    shown |= {f"{key} digest": value for key, value in inputs if key not in ("name", "version")}
    failures = {reason: f"{count} queries" for reason, count in stored.summary["failures"].items()}
    return rendered(
        "provenance.html.jinja",
        facts=facts(shown),
        failures=facts(failures) if failures else "",
        notes=[*stored.summary["notes"], *verdict.notes],
        params=json.dumps(stored.summary["method"]["params"], indent=1, ensure_ascii=False),
    )
