import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numba import njit

from lodbench.kernels import masks as kernels
from lodbench.kernels.masks import count_bits
from lodbench.rendering.bits import pack_mask, unpack_mask, words_per_row

masks = npst.arrays(np.bool_, st.tuples(st.integers(1, 6), st.integers(1, 200)))


@pytest.mark.parametrize(("width", "words"), [(1, 1), (63, 1), (64, 1), (65, 2), (128, 2), (602, 10)])
def test_words_per_row(width, words):
    assert words_per_row(width) == words


@given(masks)
def test_packing_and_unpacking_is_the_identity(mask):
    words = pack_mask(mask)
    assert words.dtype == np.uint64
    np.testing.assert_array_equal(unpack_mask(words, mask.shape[1]), mask)


def test_the_lowest_bit_is_the_leftmost_pixel():
    mask = np.zeros((1, 70), dtype=bool)
    mask[0, [0, 5, 64]] = True
    assert pack_mask(mask).tolist() == [[1 + 32, 1]]


@given(masks)
def test_counting_bits_is_counting_pixels(mask):
    assert count_bits(pack_mask(mask)) == np.count_nonzero(mask)


@njit
def intersect_and_clear(words, query):
    return kernels.intersect_and_clear(words, query)


@given(masks, st.integers(0, 2**32 - 1))
def test_intersection_and_area_against_numpy(mask, seed):
    other = np.random.default_rng(seed).random(mask.shape) < 0.5
    words = pack_mask(mask)
    assert intersect_and_clear(words, pack_mask(other)) == (
        np.count_nonzero(mask & other),
        np.count_nonzero(mask),
    )
    assert not words.any()
