"""What methods tell of their search, of the queries whose pictures a run's page shows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lodbench.harness.runs.gallery import chosen_queries
from lodbench.harness.runs.predict import open_predictions
from lodbench.reporting.page import Picture
from lodbench.reporting.run_figures import Trace, draw_evidence, draw_traces

if TYPE_CHECKING:
    import pandas as pd

# How names of stages end that tell no scores, step by step: the unit of other numbers in brackets.
_NO_SCORES, _NATS = "]", "[nats]"


def score_pictures(folder: Path, queries: pd.DataFrame, splits: Sequence[str]) -> list[Picture]:
    """Returns how the scores of the gallery's queries rose, by the run's predictions; none without steps."""
    told = [Trace(title, _scores(stages)) for title, stages in _stages(folder, queries, splits)]
    traces = [trace for trace in told if any(len(scores) > 2 for scores in trace.stages.values())]
    caption = "Best score after each step: every beam, and the best of them."
    return [_chart(draw_traces(traces), caption)] if traces else []


def evidence_pictures(folder: Path, queries: pd.DataFrame, splits: Sequence[str]) -> list[Picture]:
    """Returns by how much the answers to the gallery's queries are ahead of what else was found; or none."""
    told = [Trace(title, _behind(stages)) for title, stages in _stages(folder, queries, splits)]
    traces = [trace for trace in told if any(len(nats) > 1 for nats in trace.stages.values())]
    caption = (
        "Log-probability of the candidate poses, best first, in nats below the best: one nat is e times less "
        "probable. Logarithmic beyond 10."
    )
    return [_chart(draw_evidence(traces), caption)] if traces else []


def _stages(
    folder: Path, queries: pd.DataFrame, splits: Sequence[str]
) -> list[tuple[str, dict[str, tuple[float, ...]]]]:
    """Returns title and stages of each query of the gallery."""
    stored = open_predictions(folder, read_only=True)
    found = []
    for split in splits:
        chosen = chosen_queries(queries, split)
        for kind in ("worst", "best"):
            for key in chosen[kind].index:
                stages = stored[key].get("trace", {}) if key in stored else {}
                found.append((f"{kind}: {key}", {name: tuple(values) for name, values in stages.items()}))
    return found


def _scores(stages: dict[str, tuple[float, ...]]) -> dict[str, tuple[float, ...]]:
    return {name: values for name, values in stages.items() if not name.endswith(_NO_SCORES)}


def _behind(stages: dict[str, tuple[float, ...]]) -> dict[str, tuple[float, ...]]:
    return {
        name.removesuffix(_NATS).strip(): tuple(max(values) - value for value in values)
        for name, values in stages.items()
        if name.endswith(_NATS) and values
    }


def _chart(drawn: dict[str, bytes], caption: str) -> Picture:
    return Picture(drawn["svg"], "svg+xml", caption, "chart")
