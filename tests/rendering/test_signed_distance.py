"""The signed distance to a mask's outline: where it is 0, and against another transform."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from lodbench.rendering.masks import signed_distance


@pytest.mark.parametrize("is_exact", [True, False])
def test_distances_are_counted_from_the_outline(is_exact):
    mask = np.zeros((9, 9), bool)
    mask[:, 4:] = True
    expected = [-3.5, -2.5, -1.5, -0.5, 0.5, 1.5, 2.5, 3.5, 4.5]
    assert signed_distance(mask, is_exact)[4] == pytest.approx(expected, abs=0.0 if is_exact else 0.1)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_distances_are_exact_whatever_the_threads(threads):
    mask = np.random.default_rng(0).random((301, 402)) > 0.02
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    found = signed_distance(mask, is_exact=True)
    cv2.setNumThreads(before)
    inside, outside = (distance_transform_edt(side).astype(np.float32) for side in (mask, ~mask))
    assert np.array_equal(found, np.where(mask, inside - 0.5, 0.5 - outside))


@pytest.mark.parametrize("is_exact", [True, False])
def test_chamfer_distances_are_close_to_exact_ones(is_exact):
    mask = distance_transform_edt(np.random.default_rng(1).random((80, 90)) > 0.003) > 6
    exact = np.where(mask, distance_transform_edt(mask) - 0.5, 0.5 - distance_transform_edt(~mask))
    off = np.abs(signed_distance(mask, is_exact) - exact) / np.abs(exact)
    assert off.max() < (1e-6 if is_exact else 0.03)


@pytest.mark.parametrize("is_exact", [True, False])
@pytest.mark.parametrize("value", [True, False])
def test_a_mask_of_one_value_has_no_outline_anywhere(value, is_exact):
    distance = signed_distance(np.full((4, 6), value), is_exact)
    assert (np.abs(distance) == 10).all()
    assert (distance > 0).all() == value
