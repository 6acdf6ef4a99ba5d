"""What is stored of an answer comes back whole, and is scored by the truth alone."""

import json

import numpy as np
import pytest

from lodbench.evaluation.predictions import Prediction, encoded_mask
from lodbench.geometry import EulerAngles, Pose

POSE = Pose.from_euler(EulerAngles(40.0, 1.0, 170.0), [10.0, 20.0, 100.0])


def test_a_prediction_comes_back_as_it_was_stored():
    mask = np.random.default_rng(0).random((37, 61)) < 0.3
    made = Prediction(
        POSE, "", 0.75, 2425, {"grid": 0.5}, {"beams": (0.1, 0.2)}, 0.9, (1.0, 2.0), encoded_mask(mask),
        (POSE.shifted([1.0, 0.0, 0.0]),), (0.1,), ("far",),
    )  # fmt: skip
    again = Prediction.from_json(json.loads(json.dumps(made.to_json(), allow_nan=False)))
    np.testing.assert_array_equal(again.pose.cam_from_world, POSE.cam_from_world)
    np.testing.assert_array_equal(again.mask, mask)
    np.testing.assert_array_equal(again.alternatives[0].cam_from_world, made.alternatives[0].cam_from_world)
    names = ("notes", "failure", "score", "hypotheses", "seconds", "trace", "probability", "covariance")
    for name in (*names, "alternative_probabilities"):
        assert getattr(again, name) == getattr(made, name)


def test_a_mask_takes_about_a_bit_a_pixel_at_most():
    noise = np.random.default_rng(1).random((448, 602)) < 0.5
    assert len(encoded_mask(noise)) < 448 * 602 / 8 * 4 / 3 * 1.05


@pytest.mark.parametrize("shape", [(1, 1), (1, 602), (448, 1)])
def test_masks_of_any_size_are_kept(shape):
    mask = np.ones(shape, dtype=np.bool_)
    np.testing.assert_array_equal(Prediction(None, "no match", mask_png=encoded_mask(mask)).mask, mask)
