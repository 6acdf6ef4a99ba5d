"""Decimal numbers of a city from text."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.kernels.compiled import checked

_SEMICOLON, _PLUS, _MINUS, _DOT = 59, 43, 45, 46
_LOWER_E, _UPPER_E, _ZERO, _NINE = 101, 69, 48, 57
# Veltkamp's constant: splits a float64 into two halves whose products are exact.
_SPLITTER = 134217729.0
_MAX_MANTISSA = np.uint64(10**17)  # one digit more still fits an int64
_MAX_EXACT = np.uint64(2**53)  # of its type, or numba compares both as float64


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
def parse_decimals(  # noqa: C901 - one state machine; as three functions it takes a tenth longer
    data: NDArray[np.uint8],
    powers: NDArray[np.float64],
    values: NDArray[np.float64],
    counts: NDArray[np.int64],
    is_bad: NDArray[np.bool_],
    long_numbers: NDArray[np.int64],
) -> tuple[int, int]:  # pragma: no cover
    """Fills values, counts and is_bad; returns how many values, and how many long ones in long_numbers."""
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
        is_valid = num_digits > 0
        if is_valid and position < size and (data[position] == _LOWER_E or data[position] == _UPPER_E):
            position += 1
            is_minus = position < size and data[position] == _MINUS
            if position < size and (is_minus or data[position] == _PLUS):
                position += 1
            exponent_value = 0
            exponent_digits = 0
            while position < size and _ZERO <= data[position] <= _NINE:
                if exponent_value < 100000:
                    exponent_value = exponent_value * 10 + int(data[position] - _ZERO)
                exponent_digits += 1
                position += 1
            is_valid = exponent_digits > 0
            exponent += -exponent_value if is_minus else exponent_value
        if position < size:
            byte = data[position]
            if not (byte == _SEMICOLON or byte == 32 or 9 <= byte <= 13):
                is_valid = False
                while position < size:
                    byte = data[position]
                    if byte == _SEMICOLON or byte == 32 or 9 <= byte <= 13:
                        break
                    position += 1
        if not is_valid:
            values[num_values] = np.nan
            is_bad[ring] = True
        elif is_long or exponent < -22 or exponent > 22 or (exponent > 0 and mantissa > _MAX_EXACT):
            if num_long < len(long_numbers):
                long_numbers[num_long, 0] = num_values
                long_numbers[num_long, 1] = start
            num_long += 1
        else:
            value = _decimal(mantissa, exponent, powers)
            values[num_values] = -value if is_negative else value
        num_values += 1
        counts[ring] += 1
    return num_values, num_long
