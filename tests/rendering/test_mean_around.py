"""The mean around each pixel, against the blur it stands for."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.rendering.photo_bins import mean_around
from lodbench.storage import random_stream


@pytest.mark.parametrize("size", [(301, 224), (640, 480), (961, 719)])
@pytest.mark.parametrize("share", [8.0, 12.0])
def test_it_is_the_blur_to_a_fiftieth(size, share):
    width, height = size
    noise = random_stream(0, "mean around", width).random((height, width)).astype(np.float32)
    picture = noise + np.linspace(0.0, 2.0, width, dtype=np.float32) ** 2
    picture[: height // 3] += 1.0
    expected = cv2.GaussianBlur(picture, (0, 0), width / share)
    apart = np.abs(mean_around(picture, width / share) - expected) / picture.std()
    assert apart.max() < 0.025
    assert apart.mean() < 0.003


@given(st.integers(1, 40), st.integers(1, 40), st.floats(0.5, 200.0))
def test_of_an_even_picture_of_any_size_it_is_the_picture(height, width, sigma_px):
    picture = np.full((height, width), 0.25, dtype=np.float32)
    np.testing.assert_allclose(mean_around(picture, sigma_px), picture, atol=1e-5)
