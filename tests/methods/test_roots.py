"""Brent's method takes the steps that SciPy's takes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from lodbench.methods.region.posterior import brent_root

FUNCTIONS = [
    lambda x: x**3 - 2.0 * x - 5.0,
    lambda x: math.exp(-x) - 0.1,
    lambda x: math.atan(x - 1.7),
    lambda x: -1.0 if x < 2.0 else 1.0,
    lambda x: math.sinh(4.0 * (x - 2.2)),
    lambda x: math.tanh(50.0 * (x - 2.9)) + 1e-3 * x,
]


@pytest.mark.parametrize("tolerance", [0.3, 0.01, 1e-6, 1e-12])
@pytest.mark.parametrize("function", FUNCTIONS)
def test_every_bit_and_every_evaluation_is_that_of_scipy(function, tolerance):
    rng = np.random.default_rng(5)
    for low, high in zip(rng.uniform(0.5, 1.0, 20), rng.uniform(3.0, 9.0, 20), strict=True):
        own, theirs = [], []
        found = brent_root(lambda x, own=own: own.append(x) or function(x), low, high, tolerance)
        expected = brentq(lambda x, theirs=theirs: theirs.append(x) or function(x), low, high, xtol=tolerance)
        assert found == expected
        assert own == theirs


def test_ends_that_are_roots_and_ends_of_one_sign():
    assert brent_root(lambda x: x, 0.0, 1.0, 0.01) == 0.0
    assert brent_root(lambda x: x - 1.0, 0.0, 1.0, 0.01) == 1.0
    with pytest.raises(ValueError, match="one sign"):
        brent_root(lambda x: x + 2.0, 0.0, 1.0, 0.01)
