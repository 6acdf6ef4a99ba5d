"""What is said of answers that nothing can be compared with, and why one is not to be trusted fully."""

import re

import numpy as np
import pytest

from lodbench.evaluation.metrics import NO_TRUTH, queries_frame
from lodbench.evaluation.predictions import Prediction
from lodbench.geometry import EulerAngles, Pose
from lodbench.methods.region.trust import CONFIDENCE_STAGE
from lodbench.reporting.answers import (
    DOUBTFUL,
    GOOD,
    UNTRUSTED,
    columns_legend,
    format_answers,
    percent_text,
    probability_text,
    trust_counts,
    trust_label,
    trust_word,
    why_of,
)

POSE = Pose.from_euler(EulerAngles(40.0, 0.0, 170.0), [691512.25, 5335218.5, 655.0])


@pytest.mark.parametrize(
    ("probability", "word"), [(0.97, "good"), (0.6, "doubtful"), (0.2, "do not trust"), (None, "-")]
)
def test_a_probability_becomes_a_word(probability, word):
    assert trust_label(Prediction(POSE, probability=probability)) == word


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


DOUBTED = Pose.from_euler(EulerAngles(40.0, 0.0, 170.0), [10.0, 20.0, 100.0])
OTHER = DOUBTED.shifted((3.0, 4.0, 12.0))


def covariance(*sigmas: float) -> tuple[float, ...]:
    return tuple(np.diag(np.square(sigmas))[np.triu_indices(6)])


SURE = covariance(0.1, 0.1, 0.1, 0.1, 0.1, 0.1)


def test_a_note_of_the_method_comes_first_and_is_said_of_good_answers_too():
    note = "focal length known to 0.5 % is 1.5 m here"
    wide = covariance(1.0, 2.0, 2.0, 0.1, 0.1, 1.5)
    assert why_of(Prediction(DOUBTED, probability=0.97, covariance=wide, notes=(note,))) == (note,)
    assert why_of(Prediction(DOUBTED, probability=0.6, covariance=wide, notes=(note,))) == (
        note,
        "position +-3.0 m (east 1.0, north 2.0, height 2.0)",
        "direction +-1.5 deg",
    )


def test_another_pose_is_a_reason_where_it_is_probable():
    def second(**values):
        found = Prediction(DOUBTED, probability=0.3, covariance=SURE, alternatives=(OTHER,), **values)
        return [why for why in why_of(found) if why.startswith("2nd best")]

    place = "2nd best pose 13.0 m away, +12.0 m in height"
    assert second() == [f"{place} (worse fit)"]
    assert second(alternative_probabilities=(0.289,)) == [f"{place} (28 %)"]
    assert second(alternative_probabilities=(0.004,)) == []
    assert second(trace={"evidence [nats]": (10.0, 9.0)}) == [f"{place} (0.37 times as probable)"]
    assert second(trace={"evidence [nats]": (10.0, 1.0)}) == []


def test_a_mask_that_the_model_does_not_fill_is_a_reason():
    found = Prediction(DOUBTED, score=0.4999, probability=0.95, mask_png="there is one")
    assert why_of(found) == ("IoU of mask and model only 0.49",)
    # Without a mask a score has no unit.
    assert why_of(Prediction(DOUBTED, score=0.4999, probability=0.95)) == ()


def test_what_the_lines_of_the_map_say_against_it_is_a_reason():
    def said(*signs):
        return why_of(Prediction(DOUBTED, probability=0.6, covariance=SURE, trace={CONFIDENCE_STAGE: signs}))

    assert said(0.9, 1.0, 150.0, 0.5, 0.0) == ("the method's own estimate: nothing single stands out",)
    assert said(0.9, 2.5, 20.0, 0.1, 0.1) == (
        "edges along the map's lines fit best 2.5 m away",
        "few edges in the photo along the map's lines",
        "the height is outside the range of the prior",
    )
    assert said(0.9, 1.0, 150.0, 0.1, 0.0) == ("edges in the photo lie beside the map's lines",)


def test_without_an_answer_or_a_probability_nothing_is_made_up():
    assert why_of(Prediction(None, "no match")) == ()
    assert why_of(Prediction(DOUBTED, alternatives=(OTHER,))) == ()
