"""The inner loops of the fits, on bit-packed silhouettes.

Outlines and dilations work on rows laid end to end, each followed by a word that stays 0, with a row
of zeros above and below and a word before and after: so one plain loop over words, which the compiler
turns into vector instructions, reaches every neighbour without a look at borders.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lodbench.rendering.bits import Words, count_bits, popcount, trailing_zeros

_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
_ONE = np.uint64(1)
_TOP = np.uint64(63)


@njit(cache=True, nogil=True)
def count_overlaps(words, query):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns (N,) int64 pixels that each silhouette shares with the query, and its own."""
    shared = np.zeros(words.shape[0], dtype=np.int64)
    area = np.zeros(words.shape[0], dtype=np.int64)
    q = query.reshape(-1)
    for n in range(words.shape[0]):
        s = words[n].reshape(-1)
        both, mine = np.uint64(0), np.uint64(0)
        for i in range(s.size):
            both += popcount(s[i] & q[i])  # type: ignore[call-arg]
            mine += popcount(s[i])
        shared[n], area[n] = np.int64(both), np.int64(mine)
    return shared, area


@njit(cache=True, nogil=True)
def sum_under(words, row_sums):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns (N,) int64 sums of what lies under each silhouette, from sums along rows.

    A run of set pixels from column a to b - 1 adds ``row_sums[row, b] - row_sums[row, a]``, so only
    the ends of runs are looked at.

    Args:
        words: (N, H, S) uint64.
        row_sums: (H, W + 1) int32 sums of each row's first 0 .. W values.
    """
    totals = np.zeros(words.shape[0], dtype=np.int64)
    width = row_sums.shape[1] - 1
    for n in range(words.shape[0]):
        total = np.int64(0)
        for row in range(words.shape[1]):
            before = np.uint64(0)
            sign = np.int64(-1)
            for k in range(words.shape[2]):
                word = words[n, row, k]
                ends = word ^ ((word << _ONE) | before)
                before = word >> _TOP
                while ends != np.uint64(0):
                    column = 64 * k + np.int64(trailing_zeros(ends))  # type: ignore[call-arg]
                    total += sign * row_sums[row, column]
                    sign = -sign
                    ends &= ends - _ONE
            if before != np.uint64(0):
                total += row_sums[row, width]
        totals[n] = total
    return totals


@njit(cache=True, nogil=True)
def _stride(width):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns how many padded words hold a row."""
    return (width + 63) // 64 + 1


def valid_bits(width: int, height: int) -> Words:
    """Returns the padded words of a picture that is all set."""
    stride = _stride(width)
    rows = np.zeros((height + 2, stride), dtype=np.uint64)
    rows[1:-1, :-1] = _ALL
    if width % 64:
        rows[1:-1, -2] = np.uint64((1 << (width % 64)) - 1)
    return np.concatenate([np.zeros(1, dtype=np.uint64), rows.ravel(), np.zeros(1, dtype=np.uint64)])


def pad_words(words: Words, valid: Words) -> Words:
    """Returns the padded words of a (H, S) picture."""
    padded = np.zeros_like(valid)
    _fill(words, padded)
    return padded


def dilations(outline: Words, valid: Words, width: int, reach: int) -> NDArray[np.uint64]:
    """Returns (reach, F) pixels within 0, 1, .. reach - 1 steps of an outline, padded words."""
    grown = np.zeros((reach, len(valid)), dtype=np.uint64)
    grown[0] = outline
    wide = np.zeros_like(valid)
    for r in range(1, reach):
        _grow(grown[r - 1], valid, width, r % 2 == 0, wide, grown[r])
    return grown


@njit(cache=True, nogil=True)
def _fill(words, padded):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Writes (H, S) words into padded words."""
    stride = words.shape[1] + 1
    for row in range(words.shape[0]):
        start = 1 + (row + 1) * stride
        for k in range(words.shape[1]):
            padded[start + k] = words[row, k]


@njit(cache=True, nogil=True)
def outline_of(picture, valid, width, outline):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Writes the set pixels with an unset one beside, above or below, padded words."""
    stride = _stride(width)
    # Pixels beyond the border count as set: what the border cuts has no outline there.
    for i in range(stride + 1, picture.shape[0] - stride - 1):
        here = picture[i]
        gaps = ~here & valid[i]
        left = (gaps << _ONE) | ((~picture[i - 1] & valid[i - 1]) >> _TOP)
        right = (gaps >> _ONE) | ((~picture[i + 1] & valid[i + 1]) << _TOP)
        above = ~picture[i - stride] & valid[i - stride]
        below = ~picture[i + stride] & valid[i + stride]
        outline[i] = here & (left | right | above | below)


@njit(cache=True, nogil=True)
def _grow(picture, valid, width, is_square, wide, grown):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Writes the pixels within one step of set ones: of 8 neighbours if square, else of 4."""
    size, stride = picture.shape[0], _stride(width)
    for i in range(1, size - 1):
        here = picture[i]
        sides = (here << _ONE) | (here >> _ONE) | (picture[i - 1] >> _TOP) | (picture[i + 1] << _TOP)
        wide[i] = here | sides
    column = wide if is_square else picture
    for i in range(stride + 1, size - stride - 1):
        grown[i] = (wide[i] | column[i - stride] | column[i + stride]) & valid[i]


@njit(cache=True, nogil=True)
def _missed(outline, grown):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns how many pixels of an outline are not in a grown one."""
    count = np.uint64(0)
    for i in range(outline.shape[0]):
        count += popcount(outline[i] & ~grown[i])  # type: ignore[call-arg]
    return np.int64(count)


@njit(cache=True, nogil=True)
def distance_sums(words, query, query_grown, valid, width):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns sums of distances from each silhouette's outline to the query's, and back, and its length.

    A pixel at distance d is missed by the first d of the outlines grown by 0, 1, .. steps: counting
    misses adds up distances, cut off at the number of outlines.

    Args:
        words: (N, H, S) uint64 silhouettes.
        query: (F,) the query's outline, padded words.
        query_grown: (reach, F) the same grown.
        valid: (F,) as of ``valid_bits``.
        width: Pixels.

    Returns:
        Three (N,) int64.
    """
    count = words.shape[0]
    to_query, from_query = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    lengths = np.zeros(count, dtype=np.int64)
    picture, outline, wide = np.zeros_like(valid), np.zeros_like(valid), np.zeros_like(valid)
    near, nearer = np.zeros_like(valid), np.zeros_like(valid)
    for n in range(count):
        _fill(words[n], picture)
        outline_of(picture, valid, width, outline)
        lengths[n] = count_bits(outline)
        near[:] = outline
        for r in range(query_grown.shape[0]):
            mine, others = _missed(outline, query_grown[r]), _missed(query, near)
            if mine == 0 and others == 0:
                break
            to_query[n] += mine
            from_query[n] += others
            if others > 0:
                near, nearer = nearer, near
                _grow(nearer, valid, width, r % 2 == 1, wide, near)
    return to_query, from_query, lengths
