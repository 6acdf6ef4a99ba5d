"""What a run's page shows of a method's search: scores step by step, and evidence as what it is."""

from __future__ import annotations

from types import SimpleNamespace

import pandas as pd
import pytest

from lodbench.harness.runs import trace_pictures
from lodbench.harness.runs.trace_pictures import evidence_pictures, score_pictures

STEPS = {"coarse": [0.5], "fine": [0.1, 0.4, 0.6]}
EVIDENCE = {
    "coarse": [0.5],
    "evidence [nats]": [-7000.0, -7004.0, -7900.0],
    "signs [as of x]": [1.0, 2.0, 3.0],
}


@pytest.fixture
def shown(monkeypatch):
    """Returns the two pictures of one query of the gallery with a trace, as SVG; None of those not drawn."""

    def draw(trace):
        rows = pd.DataFrame(index=["a/1.jpg"])
        chosen = {"worst": rows, "best": rows.iloc[:0]}
        monkeypatch.setattr(trace_pictures, "chosen_queries", lambda *_: chosen)
        monkeypatch.setattr(
            trace_pictures, "open_predictions", lambda *_, **__: {"a/1.jpg": {"trace": trace}}
        )
        found = (kind(SimpleNamespace(), rows, ["a"]) for kind in (score_pictures, evidence_pictures))
        return [picture[0].content.decode() if picture else None for picture in found]

    return draw


def test_scores_are_drawn_step_by_step(shown):
    scores, evidence = shown(STEPS)
    assert ">score<" in scores
    assert evidence is None


def test_evidence_is_no_score(shown):
    scores, evidence = shown(EVIDENCE)
    assert scores is None
    assert ">nats behind the best<" in evidence
    assert "signs" not in evidence
    assert "mathdefault" not in evidence
    assert ">1.5<" not in evidence
