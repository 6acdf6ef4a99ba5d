"""One HTML page of a finished run: tables, figures, a map, every query and its picture, inside one file."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.citymodel.scene import Scene
from lodbench.evaluation import pose_error
from lodbench.evaluation.metrics import ERROR, PARTS, PRIOR_ERROR, calibrate, has_truth, of_split, own_failure
from lodbench.evaluation.pose_errors import PROBABILITY_THRESHOLD, hits_of
from lodbench.evaluation.predictions import Prediction
from lodbench.harness.runs.gallery import chosen_queries, query_pictures
from lodbench.harness.runs.places import draw_places, flight_findings, survey_table
from lodbench.harness.runs.predict import open_predictions
from lodbench.harness.runs.queries import prior_of
from lodbench.harness.runs.verify import Verdict
from lodbench.reporting import aligned_text, answers, figures, flight_words, maps, page, summaries
from lodbench.reporting.table_heads import metric_columns
from lodbench.reporting.tables import format_html, tables_of

if TYPE_CHECKING:
    import pandas as pd

# How names of stages end that tell no scores, step by step: the unit of other numbers in brackets.
_NO_SCORES = "]"
# Of more queries than this with other candidates the closest calls are shown.
_MOST_CHARTS = 60
# Head, column and format of the table of every query; texts have no format.
_SCORED_COLUMNS = (
    ("m", ERROR[0], ".2f"), ("deg", ERROR[1], ".2f"), ("along the ground m", PARTS[0], ".2f"),
    ("up m", PARTS[1], ".2f"), ("yaw deg", PARTS[2], ".2f"), ("prior m", PRIOR_ERROR[0], ".2f"),
    ("prior deg", PRIOR_ERROR[1], ".2f"),
)  # fmt: skip
# Where there is no truth: the answers themselves, as surveyors have them, and their standard deviations.
_SURE_COLUMNS = (("probability", "probability", ".2f"), ("trust", "trust", ""), ("why", "why", ""))
_ANSWER_COLUMNS = (
    ("easting m", "easting_m", ".2f"), ("northing m", "northing_m", ".2f"), ("height m", "height_m", ".2f"),
    ("latitude", "latitude_deg", ".7f"), ("longitude", "longitude_deg", ".7f"),
    ("heading deg", "heading_deg", ".2f"), ("pitch deg", "pitch_deg", ".2f"), ("roll deg", "roll_deg", ".2f"),
    ("± east m", "sigma_easting_m", ".2f"), ("± north m", "sigma_northing_m", ".2f"),
    ("± height m", "sigma_height_m", ".2f"), ("± heading deg", "sigma_heading_deg", ".2f"),
    ("± pitch deg", "sigma_pitch_deg", ".2f"), ("± roll deg", "sigma_roll_deg", ".2f"),
    ("from the prior m", "moved_m", ".2f"),
)  # fmt: skip
_LAST_COLUMNS = (
    ("score", "score", ".3f"), ("mask IoU", "mask_iou", ".3f"), ("hypotheses", "hypotheses", ".0f"),
    ("failure", "failure", ""),
)  # fmt: skip


def score_pictures(folder: Path, queries: pd.DataFrame, splits: Sequence[str]) -> list[page.Picture]:
    """Returns how the scores of the gallery's queries rose, by the run's predictions; none without steps."""
    reported = [figures.Trace(title, _scores(stages)) for title, stages in _stages(folder, queries, splits)]
    traces = [trace for trace in reported if any(len(scores) > 2 for scores in trace.stages.values())]
    caption = "Best score after each step: every beam, and the best of them."
    return [_chart(figures.draw_traces(traces), caption)] if traces else []


def evidence_pictures(predictions: Mapping[str, Prediction]) -> list[page.Picture]:
    """Returns by how much each answer is ahead of the query's other candidates, closest first; or none."""
    reported = [figures.Trace(key, _behind(prediction.trace)) for key, prediction in predictions.items()]
    traces = [trace for trace in reported if any(len(nats) > 1 for nats in trace.stages.values())]
    if not traces:
        return []
    traces.sort(key=lambda trace: (min(n[1] for n in trace.stages.values() if len(n) > 1), trace.name))
    shown = traces[:_MOST_CHARTS]
    which = f"{aligned_text.count_of(len(traces), 'queries')} with more than one candidate"
    if len(shown) < len(traces):
        which = f"The {len(shown)} closest of {which}"
    caption = (
        f"{which}, of {len(predictions)}: log-probability of the candidate poses, best first, in nats below "
        "the best: one nat is e times less probable. Logarithmic beyond 10."
    )
    return [_chart(figures.draw_evidence(shown), caption)]


def _stages(
    folder: Path, queries: pd.DataFrame, splits: Sequence[str]
) -> list[tuple[str, dict[str, tuple[float, ...]]]]:
    stored = open_predictions(folder, read_only=True)
    traces = []
    for split in splits:
        for kind, chosen in reversed(chosen_queries(queries, split).items()):
            for key in chosen.index:
                stages = stored[key].get("trace", {}) if key in stored else {}
                title = f"{kind.replace('_', ' ')}: {key}"
                traces.append((title, {name: tuple(values) for name, values in stages.items()}))
    return traces


def _scores(stages: dict[str, tuple[float, ...]]) -> dict[str, tuple[float, ...]]:
    return {name: values for name, values in stages.items() if not name.endswith(_NO_SCORES)}


def _behind(stages: Mapping[str, tuple[float, ...]]) -> dict[str, tuple[float, ...]]:
    return {
        name.removesuffix(answers.NATS).strip(): tuple(max(values) - value for value in values)
        for name, values in stages.items()
        if name.endswith(answers.NATS) and values
    }


def _chart(drawn: dict[str, bytes], caption: str) -> page.Picture:
    return page.Picture(drawn["svg"], "svg+xml", caption, "chart")


def run_report(
    verdict: Verdict, tilt: str, scene: Scene | None, view: str = "", imagery: maps.Underlay | None = None
) -> str:
    """Returns the page of a run that has been verified; ``view`` names its page in three dimensions."""
    stored = verdict.stored
    summary = summaries.with_plugin_metrics(stored.summary, verdict.computed)
    summary = summaries.with_seconds(summary, stored.provenance.get("seconds_per_query", {}))
    splits = tuple(summary["splits"])
    is_scored = bool(has_truth(stored.queries).any())
    pictures = [] if scene is None else query_pictures(verdict, scene, tilt)
    sections = [
        ("tables", "Recall", _tables(summary) if is_scored else "", []),
        ("errors", "Errors", "", _error_curves(stored.queries, splits)),
        ("calibration", "Confidence", "", _calibration(stored.queries, splits) if is_scored else []),
        ("flights", "Systematic errors of flights", _flights(verdict), []),
        ("places", "From above", draw_places(verdict, scene, tilt, view, imagery), []),
        ("queries", "Every query", _query_table(verdict, tilt, _crs_of(verdict, scene)), []),
        ("pictures", _pictures_title(len(pictures), len(stored.queries)), "", pictures),
        ("traces", "Score by step", "", score_pictures(stored.folder, stored.queries, splits)),
        ("evidence", "Other candidates", "", evidence_pictures(stored.predictions)),
        ("provenance", "Provenance", _provenance(verdict), []),
    ]
    answered = sum(prediction.pose is not None for prediction in stored.predictions.values())
    return page.rendered(
        "run.html.jinja",
        title=title_of(verdict),
        differences=verdict.differences,
        is_weak=verdict.is_weak,
        has_truth=is_scored,
        answered=f"{answered} of {len(stored.queries)} queries have an answer{_counts(stored.predictions)}.",
        untrusted=answers.untrusted_note(stored.predictions.values()),
        protocol=page.facts(summary["protocol"]),
        sections=[
            (key, title, page.markup(html), pictures)
            for key, title, html, pictures in sections
            if html or pictures
        ],
    )


def _counts(predictions: Mapping[str, Prediction]) -> str:
    """Returns how many answers are good, doubtful and not to be trusted; "" where no probability is known."""
    if all(prediction.probability is None for prediction in predictions.values()):
        return ""
    return f": {answers.trust_counts(map(answers.trust_label, predictions.values()))}"


def title_of(verdict: Verdict) -> str:
    """Returns what a run is called: its method, and the dataset."""
    summary = verdict.stored.summary
    name = " ".join(filter(None, [summary["method"]["name"], summary["method"]["variant"]]))
    return f"{name} on {summary['dataset']['name']} {summary['dataset']['version']}".strip()


def _tables(summary: dict[str, Any]) -> str:
    (table,) = tables_of([summary])
    more = {
        "intervals": "Recall, areas and medians with 95 % intervals",
        "details": "Areas under recall, parts of the error, cost",
        "calibration": "Probability of being within (2 m, 2 deg): its mean, ECE and AURC, percent",
    }
    if "ece_percent" not in table.numbers():
        del more["calibration"]
    tables = [table]
    for key, title in more.items():
        # Wide ones split by split: no column is cut off.
        parts = table.by_split() if key == "details" else [table]
        tables += [replace(part.with_columns(key), title=title) for part in parts]
    if others := summaries.plugin_metrics(summary):
        tables.append(replace(table, title="Metrics of plug-ins", columns=metric_columns(others)))
    return "".join(map(format_html, tables))


def _pictures_title(shown: int, count: int) -> str:
    return "Pictures" if shown == count else f"Pictures of {shown} of {count} queries: the worst and the best"


def _query_table(verdict: Verdict, tilt: str, crs: str | None) -> str:
    """Returns one line per query, sortable by every column that holds anything."""

    def number(name: str, value: float, spec: str) -> str:
        if name == "probability":
            return answers.probability_text(value)
        # Adding 0 turns the -0.00 of a rounded small number into 0.00.
        return format(round(value, int(spec[1])) + 0.0, spec)

    queries = verdict.stored.queries
    is_scored = has_truth(queries).any()
    stated = [verdict.stored.predictions.get(str(key)) for key in queries.index]
    frame = queries.assign(
        trust=["-" if prediction is None else answers.trust_label(prediction) for prediction in stated],
        why=["" if prediction is None else "; ".join(answers.why_of(prediction)) for prediction in stated],
    )
    if not is_scored:
        # That there is no truth is no failure of an answer.
        frame["failure"] = frame["failure"].map(own_failure)
        frame = frame.join(_answers(verdict, tilt, crs))
    first = (("query", "query", ""),) + ((("split", "split", ""),) if queries["split"].nunique() > 1 else ())
    last: Sequence[tuple[str, str, str]] = _LAST_COLUMNS
    if not is_scored and queries["probability"].notna().any():
        last = last[-1:]  # a score has no unit, and the probability says what it is worth
    middle = (*_SCORED_COLUMNS, *_SURE_COLUMNS) if is_scored else (*_SURE_COLUMNS, *_ANSWER_COLUMNS)
    columns = [*first, *middle, *last]
    kept = [column for column in columns if _holds_anything(frame[column[1]])]
    rows = list(zip(map(str, frame.index), frame.to_dict("records"), strict=True))
    names = {name for _, name, _ in kept}
    legend = answers.columns_legend("probability" in names, "score" in names)
    return page.rendered(
        "queries.html.jinja", rows=rows, columns=kept, legend=legend, isfinite=math.isfinite, number=number
    )


def _crs_of(verdict: Verdict, scene: Scene | None) -> str | None:
    """Returns the reference system of a run's poses; a run of an older version does not keep it."""
    return verdict.stored.provenance.get("crs") or (None if scene is None else scene.crs)


def _holds_anything(cells: pd.Series[Any]) -> bool:
    # Numbers, and texts under whichever of its types pandas keeps them.
    is_number = cells.dtype.kind in "fiu"
    return bool(cells.notna().any() if is_number else (cells.ne("") & cells.ne("-")).any())


def _failures(verdict: Verdict) -> Mapping[str, int]:
    """Returns how many queries failed, by reason; that there is no truth is none."""
    stored = verdict.stored
    if has_truth(stored.queries).any():
        return dict(stored.summary["failures"])
    return Counter(filter(None, stored.queries["failure"].map(own_failure)))


def _answers(verdict: Verdict, tilt: str, crs: str | None) -> pd.DataFrame:
    """Returns where each query was found, by key: columns of ``_ANSWER_COLUMNS``."""
    table, priors = survey_table(verdict.stored, crs), {}
    if verdict.dataset is not None:
        priors = {entry.key: prior_of(entry, verdict.dataset, tilt) for entry in verdict.entries}
    table["moved_m"] = math.nan
    for key, pose in verdict.stored.poses.items():
        if (prior := priors.get(key)) is not None:
            table.loc[key, "moved_m"] = pose_error(pose, prior).translation_m
    return table[[name for _, name, _ in _ANSWER_COLUMNS]]


def _error_curves(queries: pd.DataFrame, splits: Sequence[str]) -> list[page.Picture]:
    samples = []
    for split in splits:
        mine = of_split(queries, split)
        if len(mine):
            samples.append(
                figures.ErrorSample(split, mine[list(ERROR)].to_numpy(), mine[list(PRIOR_ERROR)].to_numpy())
            )
    if not samples:
        return []
    caption = "Share of all queries below an error; a failed query is never below."
    return [page.Picture(figures.draw_error_curves(samples)["svg"], "svg+xml", caption, "chart")]


def _calibration(queries: pd.DataFrame, splits: Sequence[str]) -> list[page.Picture]:
    """Returns reliability and risk over coverage by split; none where the method gave no probability."""
    curves = {}
    for split in splits:
        mine = of_split(queries, split)
        if mine["probability"].notna().any():
            hits = hits_of(mine[list(ERROR)].to_numpy(), PROBABILITY_THRESHOLD)
            curves[split] = calibrate(mine["probability"].fillna(0.0).to_numpy(), hits)
    if not curves:
        return []
    caption = "Left: share within over confidence. Right: error rate over coverage, most confident first."
    return [page.Picture(figures.draw_calibration(curves)["svg"], "svg+xml", caption, "chart")]


def _flights(verdict: Verdict) -> str:
    stated = {
        name: [
            *flight_words.constants_in_words(findings.get("constants", {}), "poses"),
            *flight_words.map_in_words(findings),
        ]
        for name, findings in flight_findings(verdict).items()
    }
    return page.rendered("run_flights.html.jinja", flights=stated) if stated else ""


def _provenance(verdict: Verdict) -> str:
    stored = verdict.stored
    hidden = {"files", "city_model", "dataset_root", "seconds_per_query"}
    known = stored.provenance.items()
    shown = {key: value for key, value in known if key not in hidden and value is not None}
    shown["run"] = stored.folder.resolve().name
    inputs = stored.summary["dataset"].items()
    shown |= {f"{key} digest": value for key, value in inputs if key not in ("name", "version")}
    failures = {
        reason: aligned_text.count_of(count, "queries") for reason, count in _failures(verdict).items()
    }
    return page.rendered(
        "provenance.html.jinja",
        facts=page.facts(shown),
        failures=page.facts(failures) if failures else "",
        notes=[*stored.summary["notes"], *verdict.notes],
        params=json.dumps(stored.summary["method"]["params"], indent=1, ensure_ascii=False),
    )
