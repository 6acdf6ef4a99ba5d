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
        zeros = builder.module.declare_intrinsic("llvm.cttz", kinds[:1], ir.FunctionType(kinds[0], kinds))
        return builder.call(zeros, [args[0], ir.Constant(kinds[1], 1)])

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
    shared, own = np.uint64(0), np.uint64(0)
    a, b = words.reshape(-1), query.reshape(-1)
    for i in range(a.size):
        shared += popcount(a[i] & b[i])
        own += popcount(a[i])
        a[i] = np.uint64(0)
    return np.int64(shared), np.int64(own)


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
        both, own = np.uint64(0), np.uint64(0)
        for i in range(s.size):
            both += popcount(s[i] & q[i])
            own += popcount(s[i])
        shared[n], area[n] = np.int64(both), np.int64(own)
    return shared, area


@checked
def sum_under(words, row_sums):
    """Returns (N,) int64 sums of what lies under each silhouette, from sums along rows.

    A run of set pixels from column a to b - 1 adds ``row_sums[row, b] - row_sums[row, a]``, so only
    the ends of runs matter.

    Args:
        words: (N, H, S) uint64.
        row_sums: (H, W + 1) int32 sums of each row's first 0 .. W values.
    """
    totals = np.zeros(words.shape[0], dtype=np.int64)
    width = row_sums.shape[1] - 1
    for n in range(words.shape[0]):
        total = np.int64(0)
        for row in range(words.shape[1]):
            carry = np.uint64(0)
            sign = np.int64(-1)
            for k in range(words.shape[2]):
                word = words[n, row, k]
                changes = word ^ ((word << _ONE) | carry)
                carry = word >> _TOP
                while changes != np.uint64(0):
                    column = 64 * k + np.int64(trailing_zeros(changes))
                    total += sign * row_sums[row, column]
                    sign = -sign
                    changes &= changes - _ONE
            if carry != np.uint64(0):
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
def outline_of(mask, valid, width, outline):
    """Writes the set pixels with an unset one beside, above or below, padded words."""
    stride = padded_stride(width)
    # Pixels beyond the border count as set: what the border cuts has no outline there.
    for i in range(stride + 1, mask.shape[0] - stride - 1):
        here = mask[i]
        unset = ~here & valid[i]
        left = (unset << _ONE) | ((~mask[i - 1] & valid[i - 1]) >> _TOP)
        right = (unset >> _ONE) | ((~mask[i + 1] & valid[i + 1]) << _TOP)
        above = ~mask[i - stride] & valid[i - stride]
        below = ~mask[i + stride] & valid[i + stride]
        outline[i] = here & (left | right | above | below)


@checked
def dilate(mask, valid, width, is_square, widened, dilated):
    """Writes a mask dilated by one pixel, padded words: by 8 neighbours if square, else by 4."""
    size, stride = mask.shape[0], padded_stride(width)
    for i in range(1, size - 1):
        word = mask[i]
        row_dilated = (word << _ONE) | (word >> _ONE) | (mask[i - 1] >> _TOP) | (mask[i + 1] << _TOP)
        widened[i] = word | row_dilated
    vertical_source = widened if is_square else mask
    for i in range(stride + 1, size - stride - 1):
        dilated[i] = (widened[i] | vertical_source[i - stride] | vertical_source[i + stride]) & valid[i]


@part
def _missed(outline, dilated):
    """Returns how many pixels of an outline are not in a dilated one."""
    count = np.uint64(0)
    for i in range(outline.shape[0]):
        count += popcount(outline[i] & ~dilated[i])
    return np.int64(count)


@checked
def distance_sums(words, query, query_dilations, valid, width):
    """Returns sums of distances from each silhouette's outline to the query's, and back, and its length.

    A pixel at distance d is missed by the first d of the outlines dilated by 0, 1, .. steps: counting
    misses adds up distances, cut off at the number of outlines.

    Args:
        words: (N, H, S) uint64 silhouettes.
        query: (F,) the query's outline, padded words.
        query_dilations: (reach, F) the same dilated by 1, 2, ... steps.
        valid: (F,) as of ``valid_bits``.
        width: Pixels.

    Returns:
        Three (N,) int64.
    """
    count = words.shape[0]
    to_query, from_query = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    lengths = np.zeros(count, dtype=np.int64)
    mask, outline, widened = np.zeros_like(valid), np.zeros_like(valid), np.zeros_like(valid)
    dilated, next_dilated = np.zeros_like(valid), np.zeros_like(valid)
    for n in range(count):
        fill_padded(words[n], mask)
        outline_of(mask, valid, width, outline)
        lengths[n] = count_bits(outline)
        dilated[:] = outline
        for r in range(query_dilations.shape[0]):
            own_misses, query_misses = _missed(outline, query_dilations[r]), _missed(query, dilated)
            if own_misses == 0 and query_misses == 0:
                break
            to_query[n] += own_misses
            from_query[n] += query_misses
            if query_misses > 0:
                dilated, next_dilated = next_dilated, dilated
                dilate(next_dilated, valid, width, r % 2 == 1, widened, dilated)
    return to_query, from_query, lengths


@part
def _update_histogram(word, changed, first_pixel, bins, counts):
    """Adds changed pixels that are set in a word to a histogram, and takes the others out."""
    while changed != np.uint64(0):
        bit = np.int64(trailing_zeros(changed))
        is_set = np.int64((word >> np.uint64(bit)) & _ONE)
        counts[bins[first_pixel + bit]] += 2 * is_set - 1
        changed &= changed - _ONE


@uncounted
def code_lengths_saved(words, bins, totals, log_gamma, inside_counts, previous, savings_nats):
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
        inside_counts: (B,) int64 zeros, working memory.
        previous: (H * S,) uint64 zeros, working memory.
        savings_nats: (N,) float64 to write.
    """
    count, num_bins = words.shape[0], totals.shape[0]
    pixels = log_gamma.shape[1] - 1
    undivided_nats = log_gamma[1, pixels]
    for b in range(num_bins):
        undivided_nats -= log_gamma[0, totals[b]]
    for n in range(count):
        silhouette = words[n]
        changed, area = np.uint64(0), np.uint64(0)
        for i in range(silhouette.size):
            changed += popcount(silhouette[i] ^ previous[i])
            area += popcount(silhouette[i])
        if changed > area:
            for b in range(num_bins):
                inside_counts[b] = 0
            for i in range(silhouette.size):
                previous[i] = np.uint64(0)
        for i in range(silhouette.size):
            _update_histogram(silhouette[i], silhouette[i] ^ previous[i], 64 * i, bins, inside_counts)
            previous[i] = silhouette[i]
        divided_nats = log_gamma[1, area] + log_gamma[1, pixels - np.int64(area)]
        for b in range(num_bins):
            divided_nats -= log_gamma[0, inside_counts[b]] + log_gamma[0, totals[b] - inside_counts[b]]
        savings_nats[n] = undivided_nats - divided_nats


@uncounted
def outline_directions(words, width, left_right, above_below):
    """Writes the outline of N silhouettes as two of (N, H, S) words.

    The first holds set pixels with an unset one to the left or right, the second with one above or below;
    the image's border is no outline.

    Args:
        words: (N, H, S) uint64.
        width: Pixels of a row.
        left_right: (N, H, S) to write, the first.
        above_below: (N, H, S) to write, the second.
    """
    height, last = words.shape[1], words.shape[2] - 1
    last_pixel = _ONE << np.uint64((width - 1) % 64)
    for n in range(words.shape[0]):
        for row in range(height):
            for k in range(last + 1):
                word = words[n, row, k]
                left = (word << _ONE) | (words[n, row, k - 1] >> _TOP if k > 0 else word & _ONE)
                right = word >> _ONE
                right |= word & last_pixel if k == last else words[n, row, k + 1] << _TOP
                above = words[n, row - 1, k] if row > 0 else word
                below = words[n, row + 1, k] if row < height - 1 else word
                left_right[n, row, k] = word & ~(left & right)
                above_below[n, row, k] = word & ~(above & below)
