"""Bit-packed masks: 64 pixels to a word, rows padded to whole words, lowest bit leftmost."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

Words = NDArray[np.uint64]


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


@njit(cache=True, nogil=True)
def count_bits(words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the number of set bits in an array of words."""
    total = np.uint64(0)
    flat = words.reshape(-1)
    for i in range(flat.size):
        total += popcount(flat[i])  # type: ignore[call-arg]
    return np.int64(total)


@njit(cache=True, nogil=True)
def intersect_and_clear(words, query):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns (set bits in both, set bits in ``words``) and clears ``words`` for the next view."""
    both, mine = np.uint64(0), np.uint64(0)
    a, b = words.reshape(-1), query.reshape(-1)
    for i in range(a.size):
        both += popcount(a[i] & b[i])  # type: ignore[call-arg]
        mine += popcount(a[i])
        a[i] = np.uint64(0)
    return np.int64(both), np.int64(mine)
