"""Bit-packed masks: counting, overlaps, outlines, dilations, and what a photo looks like on either side.

Rows of a mask are padded to whole words of 64 pixels, the lowest bit leftmost. Outlines and dilations work on
rows laid end to end, each followed by a word that stays 0, with a row of zeros above and below and a word
before and after: so one plain loop over words, which the compiler turns into vector instructions, reaches
every neighbour without a look at borders.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from lodbench.kernels.compiled import checked, part, uncounted


@intrinsic
def popcount(_context: Any, word: Any) -> Any:
    """Returns the number of set bits of a uint64 (the CPU's own instruction)."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        count = builder.module.declare_intrinsic("llvm.ctpop", [ir.IntType(64)])
        return builder.call(count, args)

    return types.uint64(types.uint64), generate


@intrinsic
def trailing_zeros(_context: Any, word: Any) -> Any:
    """Returns the place of the lowest set bit of a uint64 that is not 0."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        kinds = [ir.IntType(64), ir.IntType(1)]
        place = builder.module.declare_intrinsic("llvm.cttz", kinds[:1], ir.FunctionType(kinds[0], kinds))
        return builder.call(place, [args[0], ir.Constant(kinds[1], 1)])

    return types.uint64(types.uint64), generate


@checked
def count_bits(words):
    """Returns the number of set bits in an array of words."""
    total = np.uint64(0)
    flat = words.reshape(-1)
    for i in range(flat.size):
        total += popcount(flat[i])
    return np.int64(total)


@part
def intersect_and_clear(words, query):
    """Returns (set bits in both, set bits in ``words``) and clears ``words`` for the next view."""
    both, mine = np.uint64(0), np.uint64(0)
    a, b = words.reshape(-1), query.reshape(-1)
    for i in range(a.size):
        both += popcount(a[i] & b[i])
        mine += popcount(a[i])
        a[i] = np.uint64(0)
    return np.int64(both), np.int64(mine)


_ONE = np.uint64(1)
_TOP = np.uint64(63)


@checked
def count_overlaps(words, query):
    """Returns (N,) int64 pixels that each silhouette shares with the query, and its own."""
    shared = np.zeros(words.shape[0], dtype=np.int64)
    area = np.zeros(words.shape[0], dtype=np.int64)
    q = query.reshape(-1)
    for n in range(words.shape[0]):
        s = words[n].reshape(-1)
        both, mine = np.uint64(0), np.uint64(0)
        for i in range(s.size):
            both += popcount(s[i] & q[i])
            mine += popcount(s[i])
        shared[n], area[n] = np.int64(both), np.int64(mine)
    return shared, area


@checked
def sum_under(words, row_sums):
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
                    column = 64 * k + np.int64(trailing_zeros(ends))
                    total += sign * row_sums[row, column]
                    sign = -sign
                    ends &= ends - _ONE
            if before != np.uint64(0):
                total += row_sums[row, width]
        totals[n] = total
    return totals


@checked
def padded_stride(width):
    """Returns how many padded words hold a row."""
    return (width + 63) // 64 + 1


@checked
def fill_padded(words, padded):
    """Writes (H, S) words into padded words."""
    stride = words.shape[1] + 1
    for row in range(words.shape[0]):
        start = 1 + (row + 1) * stride
        for k in range(words.shape[1]):
            padded[start + k] = words[row, k]


@checked
def outline_of(picture, valid, width, outline):
    """Writes the set pixels with an unset one beside, above or below, padded words."""
    stride = padded_stride(width)
    # Pixels beyond the border count as set: what the border cuts has no outline there.
    for i in range(stride + 1, picture.shape[0] - stride - 1):
        here = picture[i]
        gaps = ~here & valid[i]
        left = (gaps << _ONE) | ((~picture[i - 1] & valid[i - 1]) >> _TOP)
        right = (gaps >> _ONE) | ((~picture[i + 1] & valid[i + 1]) << _TOP)
        above = ~picture[i - stride] & valid[i - stride]
        below = ~picture[i + stride] & valid[i + stride]
        outline[i] = here & (left | right | above | below)


@checked
def grow(picture, valid, width, is_square, wide, grown):
    """Writes the pixels within one step of set ones: of 8 neighbours if square, else of 4."""
    size, stride = picture.shape[0], padded_stride(width)
    for i in range(1, size - 1):
        here = picture[i]
        sides = (here << _ONE) | (here >> _ONE) | (picture[i - 1] >> _TOP) | (picture[i + 1] << _TOP)
        wide[i] = here | sides
    column = wide if is_square else picture
    for i in range(stride + 1, size - stride - 1):
        grown[i] = (wide[i] | column[i - stride] | column[i + stride]) & valid[i]


@part
def _missed(outline, grown):
    """Returns how many pixels of an outline are not in a grown one."""
    count = np.uint64(0)
    for i in range(outline.shape[0]):
        count += popcount(outline[i] & ~grown[i])
    return np.int64(count)


@checked
def distance_sums(words, query, query_grown, valid, width):
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
        fill_padded(words[n], picture)
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
                grow(nearer, valid, width, r % 2 == 1, wide, near)
    return to_query, from_query, lengths


@part
def _toggle(word, change, first, bins, counts):
    """Counts the pixels of a change in or out of a histogram: in where the word has them set."""
    while change != np.uint64(0):
        bit = np.int64(trailing_zeros(change))
        is_set = np.int64((word >> np.uint64(bit)) & _ONE)
        counts[bins[first + bit]] += 2 * is_set - 1
        change &= change - _ONE


@uncounted
def code_lengths_saved(words, bins, totals, log_gamma, inside, last, saved):
    """Writes (N,) nats that a histogram on either side of each silhouette saves over one for all.

    Each side is coded by the Krichevsky-Trofimov mixture (Dirichlet, one half per bin), whose code length
    needs the logarithms of the gamma function at half numbers only. Counts are whole numbers; silhouettes
    that come one after the other look alike, so only pixels that change are counted, unless there are
    more of them than set ones.

    Args:
        words: (N, H * S) uint64 silhouettes.
        bins: (H * S * 64,) uint16 bin of each pixel, rows padded to whole words.
        totals: (B,) int64 pixels of each bin in the whole photo.
        log_gamma: (P + 1,) float64 ``lgamma(count + 1/2) - lgamma(1/2)`` followed by (P + 1,) of
            ``lgamma(count + B/2) - lgamma(B/2)``; P pixels.
        inside: (B,) int64 and
        last: (H * S,) uint64 of zeros, to work with.
        saved: (N,) float64 to write.
    """
    count, num_bins = words.shape[0], totals.shape[0]
    pixels = log_gamma.shape[1] - 1
    whole = log_gamma[1, pixels]
    for b in range(num_bins):
        whole -= log_gamma[0, totals[b]]
    for n in range(count):
        drawn = words[n]
        changed, area = np.uint64(0), np.uint64(0)
        for i in range(drawn.size):
            changed += popcount(drawn[i] ^ last[i])
            area += popcount(drawn[i])
        if changed > area:
            for b in range(num_bins):
                inside[b] = 0
            for i in range(drawn.size):
                last[i] = np.uint64(0)
        for i in range(drawn.size):
            _toggle(drawn[i], drawn[i] ^ last[i], 64 * i, bins, inside)
            last[i] = drawn[i]
        length = log_gamma[1, area] + log_gamma[1, pixels - np.int64(area)]
        for b in range(num_bins):
            length -= log_gamma[0, inside[b]] + log_gamma[0, totals[b] - inside[b]]
        saved[n] = whole - length


@uncounted
def outline_sides(words, width, beside, upright):
    """Writes the outline of N silhouettes as two of (N, H, S) words.

    The first holds set pixels with an unset one to the left or right, the second with one above or below;
    the image's border is no outline.

    Args:
        words: (N, H, S) uint64.
        width: Pixels of a row.
        beside: (N, H, S) to write; likewise
        upright: the second.
    """
    height, last = words.shape[1], words.shape[2] - 1
    edge = _ONE << np.uint64((width - 1) % 64)
    for n in range(words.shape[0]):
        for row in range(height):
            for k in range(last + 1):
                here = words[n, row, k]
                left = (here << _ONE) | (words[n, row, k - 1] >> _TOP if k > 0 else here & _ONE)
                right = here >> _ONE
                right |= here & edge if k == last else words[n, row, k + 1] << _TOP
                above = words[n, row - 1, k] if row > 0 else here
                below = words[n, row + 1, k] if row < height - 1 else here
                beside[n, row, k] = here & ~(left & right)
                upright[n, row, k] = here & ~(above & below)
