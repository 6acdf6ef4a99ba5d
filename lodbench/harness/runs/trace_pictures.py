"""What methods tell of their search: scores of the gallery's queries, and candidates of all queries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lodbench.evaluation.predictions import Prediction
from lodbench.harness.runs.gallery import chosen_queries
from lodbench.harness.runs.predict import open_predictions
from lodbench.reporting.aligned_text import count_of
from lodbench.reporting.doubts import NATS
from lodbench.reporting.page import Picture
from lodbench.reporting.run_figures import Trace, draw_evidence, draw_traces

if TYPE_CHECKING:
    import pandas as pd

# How names of stages end that tell no scores, step by step: the unit of other numbers in brackets.
_NO_SCORES = "]"
# Of more queries than this with other candidates the closest calls are shown.
_MOST_CHARTS = 60


def score_pictures(folder: Path, queries: pd.DataFrame, splits: Sequence[str]) -> list[Picture]:
    """Returns how the scores of the gallery's queries rose, by the run's predictions; none without steps."""
    told = [Trace(title, _scores(stages)) for title, stages in _stages(folder, queries, splits)]
    traces = [trace for trace in told if any(len(scores) > 2 for scores in trace.stages.values())]
    caption = "Best score after each step: every beam, and the best of them."
    return [_chart(draw_traces(traces), caption)] if traces else []


def evidence_pictures(predictions: Mapping[str, Prediction]) -> list[Picture]:
    """Returns by how much each answer is ahead of the query's other candidates, closest first; or none."""
    told = [Trace(key, _behind(found.trace)) for key, found in predictions.items()]
    traces = [trace for trace in told if any(len(nats) > 1 for nats in trace.stages.values())]
    if not traces:
        return []
    traces.sort(key=lambda trace: (min(n[1] for n in trace.stages.values() if len(n) > 1), trace.name))
    shown = traces[:_MOST_CHARTS]
    which = f"{count_of(len(traces), 'queries')} with more than one candidate"
    if len(shown) < len(traces):
        which = f"The {len(shown)} closest of {which}"
    caption = (
        f"{which}, of {len(predictions)}: log-probability of the candidate poses, best first, in nats below "
        "the best: one nat is e times less probable. Logarithmic beyond 10."
    )
    return [_chart(draw_evidence(shown), caption)]


def _stages(
    folder: Path, queries: pd.DataFrame, splits: Sequence[str]
) -> list[tuple[str, dict[str, tuple[float, ...]]]]:
    """Returns title and stages of each query of the gallery."""
    stored = open_predictions(folder, read_only=True)
    found = []
    for split in splits:
        for kind, chosen in reversed(chosen_queries(queries, split).items()):
            for key in chosen.index:
                stages = stored[key].get("trace", {}) if key in stored else {}
                title = f"{kind.replace('_', ' ')}: {key}"
                found.append((title, {name: tuple(values) for name, values in stages.items()}))
    return found


def _scores(stages: dict[str, tuple[float, ...]]) -> dict[str, tuple[float, ...]]:
    return {name: values for name, values in stages.items() if not name.endswith(_NO_SCORES)}


def _behind(stages: Mapping[str, tuple[float, ...]]) -> dict[str, tuple[float, ...]]:
    return {
        name.removesuffix(NATS).strip(): tuple(max(values) - value for value in values)
        for name, values in stages.items()
        if name.endswith(NATS) and values
    }


def _chart(drawn: dict[str, bytes], caption: str) -> Picture:
    return Picture(drawn["svg"], "svg+xml", caption, "chart")
