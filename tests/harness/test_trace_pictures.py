"""What a run's page shows of a method's search: scores step by step, and evidence as what it is."""

import re
from types import SimpleNamespace

import pandas as pd
import pytest

from lodbench.evaluation.predictions import Prediction
from lodbench.harness.runs import report as trace_pictures
from lodbench.harness.runs.report import evidence_pictures, score_pictures

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
        chosen = {"best": rows.iloc[:0], "worst": rows}
        monkeypatch.setattr(trace_pictures, "chosen_queries", lambda *_: chosen)
        monkeypatch.setattr(
            trace_pictures, "open_predictions", lambda *_, **__: {"a/1.jpg": {"trace": trace}}
        )
        kept = Prediction(None, trace={name: tuple(values) for name, values in trace.items()})
        found = (score_pictures(SimpleNamespace(), rows, ["a"]), evidence_pictures({"a/1.jpg": kept}))
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


def test_every_query_with_other_candidates_is_drawn_the_closest_call_first():
    def answer(*nats):
        return Prediction(None, trace={"evidence [nats]": nats})

    asked = {"a/far": answer(9.0, 0.0), "a/alone": answer(9.0), "a/near": answer(9.0, 8.5, 1.0)}
    (picture,) = evidence_pictures(asked)
    drawn = picture.content.decode()
    assert "a/alone" not in drawn
    assert drawn.index(">a/near<") < drawn.index(">a/far<")
    assert picture.caption.startswith("2 queries with more than one candidate, of 3:")
    many = {f"a/{number:03}": answer(9.0, 8.0 - number) for number in range(70)}
    (picture,) = evidence_pictures(many)
    assert picture.caption.startswith("The 60 closest of 70 queries with more than one candidate, of 70:")
    assert ">a/059<" in picture.content.decode()
    assert ">a/060<" not in picture.content.decode()


@pytest.mark.parametrize("behind", [2.859213, 0.136153, 10.0, 7900.0])
def test_ticks_of_evidence_are_round_numbers(behind):
    (picture,) = evidence_pictures({"a": Prediction(None, trace={"evidence [nats]": (0.0, -behind)})})
    labels = re.findall(r">(-?[\d.]+)</text>", picture.content.decode())
    assert len(labels) >= 4
    assert all(len(label.strip("0.")) <= 2 and float(label) <= behind + 2 for label in labels)
