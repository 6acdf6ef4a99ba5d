"""Least squares under errors that go together: every outline point has a row in one covariance matrix."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Columns that are eliminated at once: a matrix of 250 rows is larger than a core's first cache, and each pass
# over it fetches all of it anew. Each number is changed in the same order as one by one.
_BLOCK = 4


@njit(cache=True, nogil=True, error_model="numpy")
def error_covariance(pixels, rises, feet, buildings, noise, lengths, errors):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the lower half of the points' error covariance, (N, N) square pixels.

    The mask's outline errs alike at points near each other in the picture: a curve that bends, without
    kinks (Matern's correlation of order 3/2). A building's roof errs as a
    whole, and by parts: alike at points near each other. So does where its walls end, as a whole.

    Args:
        pixels: (N, 2) points.
        rises: (N,) how a distance changes per metre that the roof is higher.
        feet: (N,) how it changes per metre that the base is.
        buildings: (N,) which.
        noise: Square pixels of the outline's error that goes together, and of its rest.
        lengths: Pixels over which the outline's error goes together, and a roof's.
        errors: Square metres of a roof's error as a whole, by parts, and of a base's.
    """
    count = len(pixels)
    matrix = np.zeros((count, count))
    for i in range(count):
        for j in range(i + 1):
            dx, dy = pixels[i, 0] - pixels[j, 0], pixels[i, 1] - pixels[j, 1]
            apart = np.sqrt(dx * dx + dy * dy)
            lags = np.sqrt(3.0) * apart / lengths[0]
            value = noise[0] * (1.0 + lags) * np.exp(-lags)
            if buildings[i] == buildings[j]:
                value += rises[i] * rises[j] * (errors[0] + errors[1] * np.exp(-apart / lengths[1]))
                value += feet[i] * feet[j] * errors[2]
            matrix[i, j] = value
        matrix[i, i] += noise[1]
    return matrix


@njit(cache=True, nogil=True, error_model="numpy")
def whiten(matrix, columns):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Divides columns by the Cholesky factor of a matrix, both in place; returns the log determinant.

    On one core and in one order, so that the answer depends on no library's threads.

    Args:
        matrix: (N, N) positive definite; its lower half is overwritten by the factor.
        columns: (N, M) overwritten.
    """
    count = len(matrix)
    pivots = np.empty((_BLOCK, count))
    log_determinant = 0.0
    for first in range(0, count, _BLOCK):
        last = min(first + _BLOCK, count)
        for j in range(first, last):
            root = np.sqrt(matrix[j, j])
            log_determinant += 2.0 * np.log(root)
            columns[j] /= root
            for i in range(j + 1, count):
                matrix[i, j] /= root
                pivots[j - first, i] = matrix[i, j]
                for k in range(j + 1, min(i + 1, last)):
                    matrix[i, k] -= matrix[i, j] * pivots[j - first, k]
            for i in range(j + 1, last):
                _subtract(matrix[i, j], columns[j], 0, columns[i])
        if last - first < _BLOCK:
            break
        for i in range(last, count):
            factors = matrix[i, first], matrix[i, first + 1], matrix[i, first + 2], matrix[i, first + 3]
            _subtract_four(factors, pivots, last, matrix[i, : i + 1])
            _subtract_four(factors, columns[first:last], 0, columns[i])
    return log_determinant


@njit(cache=True, nogil=True, error_model="numpy")
def _subtract(factor, row, start, target):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    for k in range(start, len(target)):
        target[k] -= factor * row[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _subtract_four(factors, rows, start, target):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Takes four multiples of rows from a target in place, one after the other, from some place on."""
    one, two, three, four = factors
    first, second, third, fourth = rows[0][start:], rows[1][start:], rows[2][start:], rows[3][start:]
    rest = target[start:]
    # Loops from 0 on are vectorised.
    for k in range(len(rest)):
        value = rest[k] - one * first[k]
        value -= two * second[k]
        value -= three * third[k]
        rest[k] = value - four * fourth[k]


@njit(cache=True, nogil=True, error_model="numpy")
def add_products(columns, share, products):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Adds ``share`` times the products of all pairs of columns to the upper half of a matrix in place.

    On one core and in one order, as ``whiten``: matrices this small cost a library more in waking threads.

    Args:
        columns: (N, M).
        share: How much of them.
        products: (M, M).
    """
    count, width = columns.shape
    for first in range(0, count - count % _BLOCK, _BLOCK):
        rows = columns[first : first + _BLOCK]
        for j in range(width):
            factors = -share * rows[0, j], -share * rows[1, j], -share * rows[2, j], -share * rows[3, j]
            _subtract_four(factors, rows, j, products[j])
    for i in range(count - count % _BLOCK, count):
        for j in range(width):
            _subtract(-share * columns[i, j], columns[i], j, products[j])
