"""The inner loops of the region fit: what a photo looks like inside and outside bit-packed silhouettes."""

from __future__ import annotations

import numpy as np
from numba import njit

from lodbench.rendering.bits import popcount, trailing_zeros

_ONE = np.uint64(1)
_TOP = np.uint64(63)


@njit(cache=True, nogil=True)
def _toggle(word, change, first, bins, counts):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Counts the pixels of a change in or out of a histogram: in where the word has them set."""
    while change != np.uint64(0):
        bit = np.int64(trailing_zeros(change))  # type: ignore[call-arg]
        is_set = np.int64((word >> np.uint64(bit)) & _ONE)
        counts[bins[first + bit]] += 2 * is_set - 1
        change &= change - _ONE


@njit(cache=True, nogil=True)
def code_lengths_saved(words, bins, totals, log_gamma):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns (N,) nats that a histogram on either side of each silhouette saves over one for all.

    Each side is coded by the Krichevsky-Trofimov mixture (Dirichlet, one half per bin), whose code length
    needs the logarithms of the gamma function at half numbers only. Counts are whole numbers; silhouettes
    that come one after the other look alike, so only pixels that change are counted, unless there are
    more of them than set ones.

    Args:
        words: (N, H, S) uint64 silhouettes.
        bins: (H * S * 64,) uint16 bin of each pixel, rows padded to whole words.
        totals: (B,) int64 pixels of each bin in the whole photo.
        log_gamma: (P + 1,) float64 ``lgamma(count + 1/2) - lgamma(1/2)`` followed by (P + 1,) of
            ``lgamma(count + B/2) - lgamma(B/2)``; P pixels.
    """
    count, num_bins = words.shape[0], totals.shape[0]
    pixels = log_gamma.shape[1] - 1
    saved = np.zeros(count)
    whole = log_gamma[1, pixels]
    for b in range(num_bins):
        whole -= log_gamma[0, totals[b]]
    inside = np.zeros(num_bins, dtype=np.int64)
    last = np.zeros(words.shape[1] * words.shape[2], dtype=np.uint64)
    for n in range(count):
        drawn = words[n].reshape(-1)
        changed, area = np.uint64(0), np.uint64(0)
        for i in range(drawn.size):
            changed += popcount(drawn[i] ^ last[i])  # type: ignore[call-arg]
            area += popcount(drawn[i])
        if changed > area:
            inside[:] = 0
            last[:] = 0
        for i in range(drawn.size):
            _toggle(drawn[i], drawn[i] ^ last[i], 64 * i, bins, inside)
            last[i] = drawn[i]
        length = log_gamma[1, area] + log_gamma[1, pixels - np.int64(area)]
        for b in range(num_bins):
            length -= log_gamma[0, inside[b]] + log_gamma[0, totals[b] - inside[b]]
        saved[n] = whole - length
    return saved


@njit(cache=True, nogil=True)
def outline_sides(words, width):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the outline of N silhouettes as two of (N, H, S) words.

    The first holds set pixels with an unset one to the left or right, the second with one above or below;
    the image's border is no outline.

    Args:
        words: (N, H, S) uint64.
        width: Pixels of a row.
    """
    beside, upright = np.zeros_like(words), np.zeros_like(words)
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
    return beside, upright
