"""Roots of functions of one variable, without ``scipy.optimize``, which takes a quarter second to load."""

from __future__ import annotations

import math
from collections.abc import Callable

# As SciPy has them: the relative tolerance that double precision allows, and more steps than any root takes.
_RELATIVE, _MOST_STEPS = 4.0 * 2.0**-52, 100


def brent_root(function: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """Returns a root by Brent's method; every step, and so every bit, is that of ``scipy.optimize.brentq``.

    Args:
        function: Continuous, with values of opposite signs at both ends.
        low: One end.
        high: The other.
        tolerance: How far off the root may be.

    Raises:
        ValueError: The values at both ends have one sign.
    """
    before, now = low, high
    at_before, at_now = function(before), function(now)
    if at_before == 0.0 or at_now == 0.0:
        return before if at_before == 0.0 else now
    if (at_before < 0.0) == (at_now < 0.0):
        raise ValueError("the values at both ends have one sign")
    other, at_other = before, at_before  # the root lies between it and the present best
    last_step = step = now - before
    for _ in range(_MOST_STEPS):
        if at_before != 0.0 and at_now != 0.0 and (at_before < 0.0) != (at_now < 0.0):
            other, at_other = before, at_before
            last_step = step = now - before
        if abs(at_other) < abs(at_now):
            before, now, other = now, other, now
            at_before, at_now, at_other = at_now, at_other, at_now
        least = (tolerance + _RELATIVE * abs(now)) / 2.0
        half = (other - now) / 2.0
        if at_now == 0.0 or abs(half) < least:
            return now
        tried = math.inf
        if abs(last_step) > least and abs(at_now) < abs(at_before):
            tried = _interpolated((before, now, other), (at_before, at_now, at_other))
        if 2.0 * abs(tried) < min(abs(last_step), 3.0 * abs(half) - least):
            last_step, step = step, tried
        else:
            last_step = step = half
        before, at_before = now, at_now
        now += step if abs(step) > least else math.copysign(least, half)
        at_now = function(now)
    return now


def _interpolated(places: tuple[float, float, float], values: tuple[float, float, float]) -> float:
    """Returns the step from the second place to where a line, or an inverse parabola, has its root."""
    (before, now, other), (at_before, at_now, at_other) = places, values
    if before == other:
        return -at_now * (now - before) / (at_now - at_before)
    slope, other_slope = (at_before - at_now) / (before - now), (at_other - at_now) / (other - now)
    above = -at_now * (at_other * other_slope - at_before * slope)
    return above / (other_slope * slope * (at_other - at_before))
