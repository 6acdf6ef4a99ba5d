"""Compiled passes over the numbers, rings and polygons of a city; ``small_cities`` has them in numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.kernels.compiled import checked

POWERS: NDArray[np.float64] = 10.0 ** np.arange(23, dtype=np.float64)  # all exact in float64
_SEMICOLON, _PLUS, _MINUS, _DOT = 59, 43, 45, 46
_LOWER_E, _UPPER_E, _ZERO, _NINE = 101, 69, 48, 57
# Veltkamp's constant: splits a float64 into two halves whose products are exact.
_SPLITTER = 134217729.0
_MAX_MANTISSA = np.uint64(10**17)  # one digit more still fits an int64
_MAX_EXACT = np.uint64(2**53)  # of its type, or numba compares both as float64


@checked
def mark_points(
    points: NDArray[np.float64],
    starts: NDArray[np.int64],
    is_kept: NDArray[np.bool_],
    lengths: NDArray[np.int64],
    is_closed: NDArray[np.bool_],
    is_repeated: NDArray[np.bool_],
) -> None:  # pragma: no cover - compiled
    """Fills which points stay, how many of each ring, which rings are closed and which repeat a point."""
    for ring in range(len(starts) - 1):
        first, last = starts[ring], starts[ring + 1] - 1
        for p in range(first, last):
            is_same = True
            for k in range(3):
                is_same &= points[p, k] == points[p + 1, k]
            is_kept[p] = not is_same
            is_repeated[ring] |= is_same
        if last >= first:
            is_same = last > first
            for k in range(3):
                is_same &= points[first, k] == points[last, k]
            is_kept[last] = not is_same
            is_closed[ring] = is_same
        for p in range(first, last + 1):
            lengths[ring] += is_kept[p]


@checked
def hash_corners(
    bits: NDArray[np.uint64],
    ring_starts: NDArray[np.int64],
    polygon_starts: NDArray[np.int64],
    chosen: NDArray[np.int64],
    hashes: NDArray[np.uint64],
) -> None:  # pragma: no cover - compiled
    """Fills two 64-bit sums over the corners of each chosen polygon, equal for equal sets of corners."""
    odd, mixer = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9)
    negative_zero, shift = np.uint64(1 << 63), np.uint64(31)
    for i in range(len(chosen)):
        total, twisted = np.uint64(0), np.uint64(0)
        first = ring_starts[polygon_starts[chosen[i]]]
        last = ring_starts[polygon_starts[chosen[i] + 1]]
        for p in range(first, last):
            key = np.uint64(0)
            for k in range(3):
                word = bits[p, k]
                if word == negative_zero:
                    word = np.uint64(0)
                key = (key ^ word) * odd
                key = (key ^ (key >> shift)) * mixer
            key ^= key >> shift
            total += key
            twisted += (key * odd) ^ (key >> shift)
        hashes[0, i] = total + np.uint64(last - first)
        hashes[1, i] = twisted


@checked
def _decimal(mantissa: np.uint64, exponent: int, powers: NDArray[np.float64]) -> float:  # pragma: no cover
    """Returns mantissa * 10**exponent, |exponent| <= 22, rounded as float() rounds it."""
    high = np.float64(mantissa)
    low = np.float64(np.int64(mantissa) - np.int64(high))
    if exponent >= 0:
        scaled: float = (high + low) * powers[exponent]
        return scaled
    power = powers[-exponent]
    quotient = high / power
    # The exact product quotient * power in two parts (Dekker), then one step of long division.
    a = _SPLITTER * quotient
    a_high = a - (a - quotient)
    a_low = quotient - a_high
    b = _SPLITTER * power
    b_high = b - (b - power)
    b_low = power - b_high
    product = quotient * power
    error = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
    corrected: float = quotient + (((high - product) - error) + low) / power
    return corrected


@checked
def scan(  # noqa: C901 - one state machine; as three functions it takes a tenth longer
    data: NDArray[np.uint8],
    powers: NDArray[np.float64],
    values: NDArray[np.float64],
    counts: NDArray[np.int64],
    is_bad: NDArray[np.bool_],
    spans: NDArray[np.int64],
) -> tuple[int, int]:  # pragma: no cover
    """Fills values, counts and is_bad; returns how many values, and how many long ones in spans."""
    size = len(data)
    position = 0
    ring = 0
    num_values = 0
    num_long = 0
    while position < size:
        byte = data[position]
        if byte == _SEMICOLON:
            ring += 1
            position += 1
            continue
        if byte == 32 or (9 <= byte <= 13):
            position += 1
            continue
        start = position
        is_negative = byte == _MINUS
        if is_negative or byte == _PLUS:
            position += 1
        mantissa = np.uint64(0)
        exponent = 0
        num_digits = 0
        is_long = False
        seen_dot = False
        while position < size:
            byte = data[position]
            if _ZERO <= byte <= _NINE:
                num_digits += 1
                if mantissa < _MAX_MANTISSA:
                    mantissa = mantissa * np.uint64(10) + np.uint64(byte - _ZERO)
                    if seen_dot:
                        exponent -= 1
                else:
                    is_long = True
            elif byte == _DOT and not seen_dot:
                seen_dot = True
            else:
                break
            position += 1
        is_clean = num_digits > 0
        if is_clean and position < size and (data[position] == _LOWER_E or data[position] == _UPPER_E):
            position += 1
            is_minus = position < size and data[position] == _MINUS
            if position < size and (is_minus or data[position] == _PLUS):
                position += 1
            written = 0
            exponent_digits = 0
            while position < size and _ZERO <= data[position] <= _NINE:
                if written < 100000:
                    written = written * 10 + int(data[position] - _ZERO)
                exponent_digits += 1
                position += 1
            is_clean = exponent_digits > 0
            exponent += -written if is_minus else written
        if position < size:
            byte = data[position]
            if not (byte == _SEMICOLON or byte == 32 or 9 <= byte <= 13):
                is_clean = False
                while position < size:
                    byte = data[position]
                    if byte == _SEMICOLON or byte == 32 or 9 <= byte <= 13:
                        break
                    position += 1
        if not is_clean:
            values[num_values] = np.nan
            is_bad[ring] = True
        elif is_long or exponent < -22 or exponent > 22 or (exponent > 0 and mantissa > _MAX_EXACT):
            if num_long < len(spans):
                spans[num_long, 0] = num_values
                spans[num_long, 1] = start
            num_long += 1
        else:
            value = _decimal(mantissa, exponent, powers)
            values[num_values] = -value if is_negative else value
        num_values += 1
        counts[ring] += 1
    return num_values, num_long
