"""Sigmoid, the paper's stretch, and the trap it sets on photos without buildings."""

import numpy as np
import pytest

from lodbench.errors import ConfigError, QueryFault
from lodbench.segmentation.probability import check_normalise, probability_of, without_unsure_parts


def logit(p):
    p = np.asarray(p, np.float64)
    return np.log(p / (1 - p)).astype(np.float32)


def test_without_a_stretch_it_is_the_sigmoid():
    p = np.array([[0.1, 0.6], [0.3, 0.9]])
    np.testing.assert_allclose(probability_of(logit(p), "none"), p, atol=1e-6)


def test_the_paper_stretches_to_0_and_1():
    found = probability_of(logit([[0.1, 0.5], [0.3, 0.9]]), "paper")
    np.testing.assert_allclose(found, [[0.0, 0.5], [0.25, 1.0]], atol=1e-6)


@pytest.mark.parametrize("values", [[[0.01, 0.02], [0.2, 0.49]], [[0.51, 0.7], [0.9, 0.99]], [[0.6, 0.6]]])
def test_a_photo_of_one_kind_only_is_not_stretched(values):
    # Unguarded, half of a photo without any building would turn into buildings.
    np.testing.assert_allclose(probability_of(logit(values), "paper"), values, atol=1e-6)


def test_huge_logits_stay_in_range():
    found = probability_of(np.array([[-1e4, 1e4]], np.float32), "none")
    assert found.tolist() == [[0.0, 1.0]]


def test_unknown_normalisations_are_named():
    with pytest.raises(ConfigError, match="minmax"):
        check_normalise("minmax")


def test_parts_that_convince_nobody_are_dropped():
    found = np.full((20, 40), 0.1, np.float32)
    found[2:12, 2:12] = 0.8  # none of it is sure
    found[2:12, 20:30] = 0.8
    found[2:3, 20:30] = 0.995  # a tenth of it is
    found[15:17, 5:15] = 0.8
    found[15, 5] = 0.995  # a twentieth
    kept = without_unsure_parts(found, 0.99)
    expected = np.zeros_like(found, bool)
    expected[2:12, 20:30] = True
    assert np.array_equal(kept >= 0.5, expected)
    assert np.array_equal(kept[expected], found[expected])
    assert kept[5, 5] == np.float32(0.4)
    assert np.array_equal(without_unsure_parts(found, 0.0), found)


@pytest.mark.parametrize("normalise", ["none", "paper"])
def test_an_answer_that_is_no_number_is_no_empty_mask(normalise):
    logits = np.zeros((4, 6), np.float32)
    logits[1, 2] = np.nan
    with pytest.raises(QueryFault, match="NaN"):
        probability_of(logits, normalise)
