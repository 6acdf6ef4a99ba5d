import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.errors import LodbenchError
from lodbench.geometry import CameraSigmas
from lodbench.geometry.camera import CALIBRATED, MAKER, UNKNOWN, split_sigmas


def test_by_provenance():
    assert CALIBRATED.are_zero
    assert (MAKER.focal_percent, MAKER.center_percent, MAKER.k1) == (0.5, 0.35, 0.01)
    assert (UNKNOWN.focal_percent, UNKNOWN.center_percent, UNKNOWN.k1) == (1.5, 0.7, 0.03)


@given(
    st.tuples(st.floats(0, 100), st.floats(0, 100), st.floats(0, 10)).filter(any),
    st.sampled_from(["stated", "35mm", "dewarp"]),
)
def test_what_is_written_is_read(numbers, source):
    sigmas = CameraSigmas(*numbers, source)
    assert split_sigmas(["PINHOLE", "4", *sigmas.words()]) == (["PINHOLE", "4"], sigmas)


def test_words_that_lack_are_exact_and_percents_need_no_sign():
    assert split_sigmas(["PINHOLE"]) == (["PINHOLE"], None)
    assert split_sigmas(["PINHOLE", "sigma_f=2"])[1] == CameraSigmas(2.0, 0.0, 0.0, "stated")
    assert split_sigmas(["sigma_c=0.7%", "sigma_k1=0.03", "sigma_by=35mm"])[1] == CameraSigmas(
        0.0, 0.7, 0.03, "35mm"
    )
    assert CALIBRATED.words() == []


def test_a_focal_length_by_a_photo_is_not_one_that_a_person_stated():
    assert split_sigmas(["sigma_f=2"])[1].stated_focal_percent == 2.0
    assert MAKER.stated_focal_percent is None


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["sigma_q=1"], "no deviation of a camera"),
        (["sigma_f=1", "200"], "no deviation of a camera"),
        (["sigma_f=1", "sigma_f=1"], "given twice"),
        (["sigma_f="], "no value"),
        (["sigma_f=-1%"], r"sigma_f=-1% is not within 0 to 100%"),
        (["sigma_c=101%"], "not within"),
        (["sigma_k1=1%"], "not within 0 to 10"),
        (["sigma_k1=nan"], "not within"),
        (["sigma_f=wide"], "not within"),
    ],
)
def test_what_is_no_deviation(words, reason):
    with pytest.raises(LodbenchError, match=reason):
        split_sigmas(words)
