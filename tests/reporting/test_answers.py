"""What is told of answers that nothing can be compared with."""

from __future__ import annotations

import pytest

from lodbench.evaluation.predictions import Prediction
from lodbench.evaluation.queries import NO_TRUTH, queries_frame
from lodbench.geometry import EulerAngles, Pose
from lodbench.reporting.answers import format_answers, trust_of

POSE = Pose.from_euler(EulerAngles(40.0, 0.0, 170.0), [691512.25, 5335218.5, 655.0])


@pytest.mark.parametrize(
    ("probability", "word"), [(0.97, "good"), (0.6, "doubtful"), (0.2, "do not trust"), (None, "-")]
)
def test_a_probability_becomes_a_word(probability, word):
    assert trust_of(Prediction(POSE, probability=probability)) == word


def test_every_query_has_a_line_and_failures_are_counted():
    rows = [{"query": name, "split": "a", "failure": NO_TRUTH} for name in ("1.jpg", "2.jpg")]
    answers = {
        "a/1.jpg": Prediction(POSE, "", 0.81, probability=0.97),
        "a/2.jpg": Prediction(None, "no match"),
    }
    text = format_answers(queries_frame(rows), answers)
    first, second = [line.split() for line in text.splitlines() if line.startswith("a/")]
    assert first == [
        "a/1.jpg",
        "691512.25",
        "5335218.50",
        "655.00",
        "190.00",
        "-50.00",
        "0.00",
        "0.810",
        "0.970",
        "good",
    ]
    assert second[-1] == "failed"
    assert "1 of 2 queries have an answer, 1 failed" in text
    assert "1 x no match" in text.splitlines()
