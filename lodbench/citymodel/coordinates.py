"""Decimal numbers from text, many rings in one pass: strict, exact, about ten times faster than float().

Only plain decimals are accepted (``-12.5``, ``3e2``): no ``nan``, ``inf``, ``1_000`` or digits of
other scripts, all of which Python's ``float`` takes.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

_SEPARATOR = b";"
# Numbers of all texts of a process up to which no kernel is loaded: Python reads these in 0.2 s, and
# numba takes 0.4 to load.
_FEW_NUMBERS = 1_000_000
# Plain decimals between white space, as ``kernels.city.scan`` takes them.
_DECIMAL = rb"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?"
_NUMBER = re.compile(_DECIMAL)
_NUMBERS = re.compile(rb"\s*(?:%s(?:\s+|\Z))*" % _DECIMAL)
_num_seen = 0


def parse_rings(texts: list[bytes]) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Returns the numbers of many texts, how many each has, and which texts are not clean.

    A text that holds anything but finite decimals is not clean; its numbers are NaN where they
    could not be read. An empty text has no numbers and is clean.

    Args:
        texts: Numbers separated by white space, one text per ring, in ASCII where they are clean.

    Returns:
        values: (V,) float64, all texts in a row.
        counts: (R,) int64 numbers per text.
        is_bad: (R,) bool.

    Example:
        >>> parse_rings([b"1 2.5", b"3 nan"])[1:]
        (array([2, 2]), array([False,  True]))
    """
    joined = _SEPARATOR.join(texts)
    if not joined.isascii() or joined.count(_SEPARATOR) != len(texts) - 1:
        foreign = [not text.isascii() or _SEPARATOR in text for text in texts]
        clean = [b"?" if is_foreign else text for text, is_foreign in zip(texts, foreign, strict=True)]
        texts, joined = clean, _SEPARATOR.join(clean)
    if is_few(len(joined) // 8):  # a number has seven characters and a blank at least, mostly
        return _parse_few(texts)
    from lodbench.kernels.city import POWERS, scan

    if not texts:
        return np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.bool_)
    data = np.frombuffer(joined, dtype=np.uint8)
    values = np.zeros(len(data) // 2 + 1)
    spans = np.zeros((0, 2), np.int64)
    while True:
        counts = np.zeros(len(texts), np.int64)
        is_bad = np.zeros(len(texts), np.bool_)
        num_values, num_long = scan(data, POWERS, values, counts, is_bad, spans)
        if num_long <= len(spans):
            break
        spans = np.zeros((num_long, 2), np.int64)  # rare, so room is made only when there are some
    values = values[:num_values].copy()
    _repair_long(joined, values, counts, is_bad, spans[:num_long])
    return values, counts, is_bad


def is_few(num_numbers: int) -> bool:
    """Counts numbers; returns whether there are so few in all that no kernel is worth its loading."""
    global _num_seen
    _num_seen += num_numbers
    return _num_seen <= _FEW_NUMBERS


def _parse_few(
    texts: list[bytes],
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Returns what ``parse_rings`` does of texts in ASCII, by Python's own ``float``."""
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


def _repair_long(
    joined: bytes,
    values: NDArray[np.float64],
    counts: NDArray[np.int64],
    is_bad: NDArray[np.bool_],
    spans: NDArray[np.int64],
) -> None:
    """Reads the rare numbers with more digits or exponent than the fast path takes, in place.

    Args:
        joined: The text that was scanned.
        values: (V,) whose marked entries are replaced.
        counts: (R,) numbers per ring.
        is_bad: (R,) set where such a number overflows.
        spans: (L, 2) index of the value and offset of its text.
    """
    if len(spans) == 0:
        return
    ends = np.cumsum(counts)
    for index, offset in spans.tolist():
        token = joined[offset : offset + 400].split(_SEPARATOR)[0].split(maxsplit=1)[0]
        values[index] = float(token)
        if not np.isfinite(values[index]):
            is_bad[np.searchsorted(ends, index, side="right")] = True
