"""Passes over small cities in numpy: to load kernels, or compile them, takes longer; the same bits."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.raw import take_segments

# Coordinates of all passes of a process up to which no kernel is loaded: these take 0.1 s, numba 0.4.
_FEW_NUMBERS = 1_000_000
# Plain decimals between white space, as ``kernels.city.scan`` takes them.
_DECIMAL = rb"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?"
_NUMBER = re.compile(_DECIMAL)
_NUMBERS = re.compile(rb"\s*(?:%s(?:\s+|\Z))*" % _DECIMAL)
_num_seen = 0


def is_few(num_numbers: int) -> bool:
    """Counts coordinates; returns whether there are so few in all that no kernel is worth its loading."""
    global _num_seen
    _num_seen += num_numbers
    return _num_seen <= _FEW_NUMBERS


def scan(texts: list[bytes]) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Returns what ``coordinates.parse_rings`` does of texts in ASCII."""
    values: list[float] = []
    counts = np.zeros(len(texts), np.int64)
    is_bad = np.zeros(len(texts), np.bool_)
    for n, data in enumerate(texts):
        words = data.split()
        if _NUMBERS.fullmatch(data):
            found = [float(word) for word in words]
            is_bad[n] = not np.isfinite(found).all()
        else:
            found = [float(word) if _NUMBER.fullmatch(word) else np.nan for word in words]
            is_bad[n] = True
        counts[n] = len(found)
        values += found
    return np.array(values, np.float64), counts, is_bad


def mark_points(
    points: NDArray[np.float64],
    starts: NDArray[np.int64],
    is_kept: NDArray[np.bool_],
    lengths: NDArray[np.int64],
    is_closed: NDArray[np.bool_],
    is_repeated: NDArray[np.bool_],
) -> None:
    """Fills what ``kernels.city.mark_points`` does."""
    rings = np.flatnonzero(np.diff(starts) > 0)
    first, last = starts[rings], starts[rings + 1] - 1
    is_repeat = np.zeros(len(points), np.bool_)
    is_repeat[:-1] = (points[1:] == points[:-1]).all(axis=1)
    is_repeat[last] = False
    is_closed[rings] = (first < last) & (points[first] == points[last]).all(axis=1)
    is_repeated |= np.diff(_sums(is_repeat)[starts]) > 0
    is_kept[:] = ~is_repeat
    is_kept[last] = ~is_closed[rings]
    lengths += np.diff(_sums(is_kept)[starts])


def hash_corners(
    bits: NDArray[np.uint64],
    ring_starts: NDArray[np.int64],
    polygon_starts: NDArray[np.int64],
    chosen: NDArray[np.int64],
    hashes: NDArray[np.uint64],
) -> None:
    """Fills what ``kernels.city.hash_corners`` does."""
    odd, mixer, shift = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(31)
    corners, starts = take_segments(ring_starts[polygon_starts], chosen)
    key = np.zeros(len(corners), np.uint64)
    for word in bits[corners].T:
        key = (key ^ np.where(word == np.uint64(1 << 63), np.uint64(0), word)) * odd
        key = (key ^ (key >> shift)) * mixer
    key ^= key >> shift
    hashes[0] = np.diff(_sums(key)[starts]) + np.diff(starts).astype(np.uint64)
    hashes[1] = np.diff(_sums((key * odd) ^ (key >> shift))[starts])


def _sums(values: NDArray[np.integer] | NDArray[np.bool_]) -> NDArray[np.integer]:
    """Returns the sums of all values before each, and of all; those of uint64 overflow as in C."""
    kind = np.uint64 if values.dtype == np.uint64 else np.int64
    return np.concatenate([np.zeros(1, kind), np.cumsum(values, dtype=kind)])
