"""The covariance of outline points, and whitening by it, against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lodbench.kernels.estimation import add_products, error_covariance, whiten


@pytest.fixture(scope="module")
def points():
    generator = np.random.default_rng(3)
    rises, feet = generator.normal(size=(2, 40))
    return generator.uniform(0, 300, (40, 2)), rises, feet, generator.integers(0, 4, 40)


def test_covariance_is_the_sum_of_what_is_shared(points):
    pixels, rises, feet, buildings = points
    matrix = error_covariance(*points, (2.0, 0.5), (30.0, 60.0), (4.0, 9.0, 2.5))
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    own = np.outer(rises, rises) * (4.0 + 9.0 * np.exp(-apart / 60.0)) + 2.5 * np.outer(feet, feet)
    same = buildings[:, None] == buildings[None]
    lags = np.sqrt(3.0) * apart / 30.0
    expected = 2.0 * (1.0 + lags) * np.exp(-lags) + np.where(same, own, 0.0) + 0.5 * np.eye(40)
    np.testing.assert_allclose(matrix, np.tril(expected), rtol=1e-12)


@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
@settings(deadline=None, max_examples=30)
def test_whitened_products_are_those_of_the_inverse(seed, count):
    generator = np.random.default_rng(seed)
    root = generator.normal(size=(count, count))
    matrix = root @ root.T + 0.1 * np.eye(count)
    columns = generator.normal(size=(count, 7))
    whitened = columns.copy()
    log_determinant = whiten(np.tril(matrix), whitened)
    np.testing.assert_allclose(
        whitened.T @ whitened, columns.T @ np.linalg.solve(matrix, columns), rtol=1e-6, atol=1e-9
    )
    assert log_determinant == pytest.approx(np.linalg.slogdet(matrix)[1], abs=1e-6)


@pytest.mark.parametrize("count", [1, 3, 4, 9, 30])
def test_products_of_columns_are_added_to_the_upper_half(count):
    generator = np.random.default_rng(count)
    columns, before = generator.normal(size=(count, 6)), generator.normal(size=(6, 6))
    products = before.copy()
    add_products(columns, 0.25, products)
    np.testing.assert_allclose(np.triu(products), np.triu(before + 0.25 * columns.T @ columns), atol=1e-12)
