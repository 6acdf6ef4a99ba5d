"""Why an answer is not to be trusted fully, from what its prediction stores."""

import numpy as np

from lodbench.evaluation.predictions import Prediction
from lodbench.geometry import EulerAngles, Pose
from lodbench.methods.region.trust import SIGNS_STAGE
from lodbench.reporting.answers import why_of

POSE = Pose.from_euler(EulerAngles(40.0, 0.0, 170.0), [10.0, 20.0, 100.0])
OTHER = POSE.shifted((3.0, 4.0, 12.0))


def covariance(*sigmas: float) -> tuple[float, ...]:
    return tuple(np.diag(np.square(sigmas))[np.triu_indices(6)])


SURE = covariance(0.1, 0.1, 0.1, 0.1, 0.1, 0.1)


def test_a_note_of_the_method_comes_first_and_is_said_of_good_answers_too():
    note = "focal length known to 0.5 % is 1.5 m here"
    wide = covariance(1.0, 2.0, 2.0, 0.1, 0.1, 1.5)
    assert why_of(Prediction(POSE, probability=0.97, covariance=wide, notes=(note,))) == (note,)
    assert why_of(Prediction(POSE, probability=0.6, covariance=wide, notes=(note,))) == (
        note,
        "position +-3.0 m (east 1.0, north 2.0, height 2.0)",
        "direction +-1.5 deg",
    )


def test_another_pose_is_a_reason_where_it_is_probable():
    def second(**values):
        found = Prediction(POSE, probability=0.3, covariance=SURE, alternatives=(OTHER,), **values)
        return [why for why in why_of(found) if why.startswith("2nd best")]

    place = "2nd best pose 13.0 m away, +12.0 m in height"
    assert second() == [f"{place} (worse fit)"]
    assert second(alternative_probabilities=(0.289,)) == [f"{place} (28 %)"]
    assert second(alternative_probabilities=(0.004,)) == []
    assert second(trace={"evidence [nats]": (10.0, 9.0)}) == [f"{place} (0.37 times as probable)"]
    assert second(trace={"evidence [nats]": (10.0, 1.0)}) == []


def test_a_mask_that_the_model_does_not_fill_is_a_reason():
    found = Prediction(POSE, score=0.4999, probability=0.95, mask_png="there is one")
    assert why_of(found) == ("IoU of mask and model only 0.49",)
    # Without a mask a score has no unit.
    assert why_of(Prediction(POSE, score=0.4999, probability=0.95)) == ()


def test_what_the_lines_of_the_map_say_against_it_is_a_reason():
    def said(*signs):
        return why_of(Prediction(POSE, probability=0.6, covariance=SURE, trace={SIGNS_STAGE: signs}))

    assert said(0.9, 1.0, 150.0, 0.5, 0.0) == ("the method's own estimate: nothing single stands out",)
    assert said(0.9, 2.5, 20.0, 0.1, 0.1) == (
        "edges along the map's lines fit best 2.5 m away",
        "few edges in the photo along the map's lines",
        "the height is outside the range of the prior",
    )
    assert said(0.9, 1.0, 150.0, 0.1, 0.0) == ("edges in the photo lie beside the map's lines",)


def test_without_an_answer_or_a_probability_nothing_is_made_up():
    assert why_of(Prediction(None, "no match")) == ()
    assert why_of(Prediction(POSE, alternatives=(OTHER,))) == ()
