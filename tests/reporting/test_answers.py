"""What is told of answers that nothing can be compared with."""

import re

import numpy as np
import pytest

from lodbench.evaluation.predictions import Prediction
from lodbench.evaluation.queries import NO_TRUTH, queries_frame
from lodbench.geometry import EulerAngles, Pose
from lodbench.reporting.answers import (
    DOUBTFUL,
    GOOD,
    UNTRUSTED,
    columns_legend,
    format_answers,
    percent_text,
    probability_text,
    trust_counts,
    trust_of,
    trust_word,
)

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
    assert first == "a/1.jpg 691512.25 5335218.50 655.00 190.00 -50.00 0.00 0.810 0.970 good".split()
    assert second[-1] == "failed"
    assert "1 of 2 queries have an answer: 1 good, 1 failed." in text
    assert "1 x no match" in text.splitlines()


@pytest.mark.parametrize("probability", [0.89999, 0.895, 0.9, 0.5, 0.49999, 0.29, 0.57, 1.0, 0.0, 1e-9])
@pytest.mark.parametrize("digits", [2, 3, 4])
def test_a_probability_and_its_word_agree_at_every_number_of_digits(probability, digits):
    shown = probability_text(probability, digits)
    assert trust_word(float(shown)) == trust_word(probability)
    assert probability - 10.0**-digits < float(shown) <= probability
    assert trust_word(float(percent_text(probability).removesuffix(" %")) / 100) == trust_word(probability)


def test_answers_are_counted_by_their_words():
    words = [GOOD, *[DOUBTFUL] * 5, UNTRUSTED, UNTRUSTED, "failed", "-"]
    assert trust_counts(words) == "1 good, 5 doubtful, 2 not to be trusted, 1 of unknown trust, 1 failed"
    assert trust_counts([]) == ""


def test_a_legend_has_the_thresholds_that_the_words_have():
    legend = columns_legend(True, True)
    least = [float(number) for number in re.findall(r"from ([\d.]+)", legend)]
    assert [trust_word(number) for number in least] == ["good", "doubtful"]
    assert [trust_word(np.nextafter(number, 0.0)) for number in least] == ["doubtful", "do not trust"]
    assert "standard deviation" in legend
    assert columns_legend(False, True).startswith("Score: ")
    assert columns_legend(False, False) == ""
