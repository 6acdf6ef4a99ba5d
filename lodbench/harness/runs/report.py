"""One HTML page of a finished run: tables, figures, galleries and every query, all inside one file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.errors import LodbenchError
from lodbench.evaluation.calibration import calibrate
from lodbench.evaluation.errors import FAILED
from lodbench.evaluation.recall import PROBABILITY_THRESHOLD, hits_of
from lodbench.evaluation.rows import QueryRow
from lodbench.harness.city import open_city
from lodbench.harness.runs.gallery import chosen_rows, overlay_name
from lodbench.harness.runs.predict import open_predictions
from lodbench.harness.runs.prepare import prior_of
from lodbench.harness.runs.verify import Verdict
from lodbench.reporting.calibration_figures import draw_calibration
from lodbench.reporting.page import definition_list, html_page, picture, section, text
from lodbench.reporting.query_table import query_table
from lodbench.reporting.run_figures import (
    ErrorSample,
    Places,
    Trace,
    draw_error_curves,
    draw_top_view,
    draw_traces,
)
from lodbench.reporting.summaries import with_seconds
from lodbench.reporting.table_columns import calibration_columns, detail_columns, interval_columns
from lodbench.reporting.table_html import format_html
from lodbench.reporting.tables import tables_of

Floats = NDArray[np.float64]
# JPEG quality of the pictures inside the page: outlines stay sharp, a picture weighs about 60 kB.
_QUALITY = 82


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
    labels = table.labels()
    tables = [
        table,
        replace(table, columns=interval_columns(labels), title="Recall with 95 % intervals"),
        replace(table, columns=detail_columns(labels), title="Areas under recall, parts of the error, cost"),
    ]
    if table.says_how_sure():
        title = (
            "Probability of being within (2 m, 2 deg): said, its distance from what was found, risk; percent"
        )
        tables.append(replace(table, columns=calibration_columns(labels), title=title))
    name = " ".join(filter(None, [summary["method"]["name"], summary["method"]["variant"]]))
    parts = {
        "tables": ("Recall", "".join(map(format_html, tables))),
        "errors": ("Errors", _error_curves(stored.rows, splits)),
        "calibration": ("How sure it was", _calibration(stored.rows, splits)),
        "places": ("From above", _top_views(verdict, splits, tilt)),
        "worst": ("Worst queries", _gallery(stored.folder, stored.rows, splits, "worst")),
        "best": ("Best queries", _gallery(stored.folder, stored.rows, splits, "best")),
        "traces": ("How the score rose", _traces(stored.folder, stored.rows, splits)),
        "queries": ("Every query", query_table(stored.rows)),
        "provenance": ("Where it comes from", _provenance(verdict)),
    }
    links = "".join(f'<a href="#{key}">{text(title)}</a>' for key, (title, body) in parts.items() if body)
    sections = "".join(section(key, title, body) for key, (title, body) in parts.items() if body)
    dataset = f"{summary['dataset']['name']} {summary['dataset']['version']}".strip()
    head = (
        f"<h1>{text(name)} on {text(dataset)}</h1>\n{_badge(verdict)}{definition_list(summary['protocol'])}"
    )
    return html_page(f"{name} on {dataset}", f"{head}<nav>{links}</nav>\n{sections}")


def _badge(verdict: Verdict) -> str:
    """Returns whether the numbers of the page follow from the poses."""
    if verdict.differences:
        lines = "".join(f"<li>{text(line)}</li>" for line in verdict.differences[:20])
        count = len(verdict.differences)
        return f'<p class="bad">Not verified: {count} differences</p><ul>{lines}</ul>\n'
    if verdict.is_weak:
        return '<p class="soft">Verified against its own rows only: the dataset is not where it was.</p>\n'
    return '<p class="good">Verified: every number follows from the stored poses and the truth.</p>\n'


def _error_curves(rows: Sequence[QueryRow], splits: Sequence[str]) -> str:
    samples = []
    for split in splits:
        mine = [row for row in rows if row.split == split and row.error is not None]
        if mine:
            estimates, priors = [row.error for row in mine], [row.prior_error or FAILED for row in mine]
            samples.append(ErrorSample(split, np.array(estimates), np.array(priors)))
    if not samples:
        return ""
    caption = "Share of all queries below an error; a failed query is never below."
    return picture(draw_error_curves(samples)["svg"], "svg+xml", caption, "chart")


def _calibration(rows: Sequence[QueryRow], splits: Sequence[str]) -> str:
    """Returns reliability and risk over coverage by split; "" where the method gave no probability."""
    curves = {}
    for split in splits:
        mine = [row for row in rows if row.split == split and row.error is not None]
        if any(row.probability is not None for row in mine):
            errors = np.array([row.error for row in mine], dtype=np.float64)
            found = hits_of(errors, PROBABILITY_THRESHOLD).tolist()
            curves[split] = calibrate([row.probability or 0.0 for row in mine], found)
    if not curves:
        return ""
    caption = (
        "Left: what was said and what was found; right: what is wrong of the answers let in, surest first."
    )
    return picture(draw_calibration(curves)["svg"], "svg+xml", caption, "chart")


def _top_views(verdict: Verdict, splits: Sequence[str], tilt: str) -> str:
    if verdict.dataset is None:
        return ""
    scene = _scene(verdict)
    ground, triangles = None, None
    if scene is not None:
        ground, triangles = scene.vertices[:, :2] + scene.origin[:2], scene.triangles
    parts = []
    for split in splits:
        places = _places(verdict, split, tilt)
        if np.isfinite(places.truths).any():
            caption = f"{split}: from each truth a line to its prior and to its estimate."
            parts.append(picture(draw_top_view(places, ground, triangles)["png"], "png", caption, "chart"))
    return f'<div class="charts">{"".join(parts)}</div>' if parts else ""


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
    poses = {row.key: row.pose for row in verdict.stored.rows}
    columns: list[list[Floats]] = [[], [], []]
    for entry in verdict.entries:
        if entry.split == split:
            prior = prior_of(entry, verdict.dataset, tilt)
            for column, pose in zip(
                columns, (prior, poses.get(entry.key), verdict.dataset.truth.get(entry.key)), strict=True
            ):
                column.append(np.full(2, np.nan) if pose is None else pose.center[:2])
    return Places(*(np.array(column).reshape(-1, 2) for column in columns))


def _gallery(folder: Path, rows: Sequence[QueryRow], splits: Sequence[str], kind: str) -> str:
    """Returns the overlays that the run left, as far as they are there."""
    figures = []
    for split in splits:
        for rank, row in enumerate(chosen_rows(rows, split)[kind], start=1):
            path = folder / "overlays" / overlay_name(split, kind, rank, row.name)
            content = _jpeg(path)
            if content is not None:
                figures.append(picture(content, "jpeg", _caption(row)))
    return f'<div class="gallery">{"".join(figures)}</div>' if figures else ""


def _jpeg(path: Path) -> bytes | None:
    import cv2

    image = cv2.imread(str(path)) if path.is_file() else None
    if image is None:
        return None
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())


def _caption(row: QueryRow) -> str:
    if row.failure or row.error is None:
        return f"{row.key}: {row.failure}"
    return f"{row.key}: {row.error.translation_m:.2f} m, {row.error.rotation_deg:.2f} deg"


def _traces(folder: Path, rows: Sequence[QueryRow], splits: Sequence[str]) -> str:
    """Returns the score traces of the gallery's queries, from the run's predictions."""
    stored = open_predictions(folder, read_only=True)
    traces = []
    for split in splits:
        chosen = chosen_rows(rows, split)
        for kind in ("worst", "best"):
            for row in chosen[kind]:
                stages = stored[row.key].get("trace", {}) if row.key in stored else {}
                if any(len(scores) > 1 for scores in stages.values()):
                    traces.append(Trace(f"{kind}: {row.key}", {k: tuple(v) for k, v in stages.items()}))
    if not traces:
        return ""
    caption = "Best score after each step: every beam, and the best of them."
    return picture(draw_traces(traces)["svg"], "svg+xml", caption, "chart")


def _provenance(verdict: Verdict) -> str:
    stored = verdict.stored
    hidden = {"files", "city_model", "dataset_root", "seconds_per_query"}
    known = stored.provenance.items()
    facts = {key: value for key, value in known if key not in hidden and value is not None}
    facts["run"] = stored.folder.resolve().name
    inputs = stored.summary["dataset"].items()
    facts |= {f"{key} digest": value for key, value in inputs if key not in ("name", "version")}
    failures = {reason: f"{count} queries" for reason, count in stored.summary["failures"].items()}
    notes = [*stored.summary["notes"], *verdict.notes]
    parts = [definition_list(facts)]
    parts += [f"<h3>Failures</h3>{definition_list(failures)}"] if failures else []
    parts += ["<h3>Notes</h3><ul>", *(f"<li>{text(note)}</li>" for note in notes), "</ul>"] if notes else []
    params = json.dumps(stored.summary["method"]["params"], indent=1, ensure_ascii=False)
    parts.append(f"<details><summary>Method settings</summary><pre>{text_lines(params)}</pre></details>")
    return "".join(parts)


def text_lines(value: str) -> str:
    """Returns several lines as HTML text."""
    return "\n".join(text(line) for line in value.splitlines())
