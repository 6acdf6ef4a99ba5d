"""Bit-packed masks: 64 pixels to a word, rows padded to whole words, lowest bit leftmost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Words = NDArray[np.uint64]


def words_per_row(width: int) -> int:
    """Returns how many 64-bit words hold a row of ``width`` pixels."""
    return (width + 63) // 64


def pack_mask(mask: NDArray[np.bool_]) -> Words:
    """Returns the (H, ceil(W / 64)) uint64 words of a (H, W) mask; padding bits are 0."""
    height, width = mask.shape
    padded = np.zeros((height, words_per_row(width) * 64), dtype=np.uint8)
    padded[:, :width] = mask
    return np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64, copy=False)


def unpack_mask(words: Words, width: int) -> NDArray[np.bool_]:
    """Returns the (H, W) mask of (H, ceil(W / 64)) words."""
    octets = np.ascontiguousarray(words, dtype="<u8").view(np.uint8)
    return np.unpackbits(octets, axis=1, bitorder="little")[:, :width].astype(np.bool_)
