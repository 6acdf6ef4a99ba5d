"""Sparse normal equations, summed block by block: of photos, what they share, and ties between them."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]


class NormalEquations:
    """Curvature and slope of a sum of squares.

    Args:
        size: Number of unknowns.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._gradient = np.zeros(size)
        self._rows: list[Rows] = []
        self._columns: list[Rows] = []
        self._values: list[Floats] = []

    def add(self, unknowns: Rows, curvature: Floats, slope: Floats) -> None:
        """Adds a block, (N, N) and (N,), at N unknowns; what is 0 in it costs nothing later."""
        rows, columns = np.nonzero(curvature)
        self._rows.append(unknowns[rows])
        self._columns.append(unknowns[columns])
        self._values.append(curvature[rows, columns])
        np.add.at(self._gradient, unknowns, slope)

    def add_sparse(self, curvature: scipy.sparse.coo_matrix) -> None:
        """Adds curvature of all unknowns, symmetric."""
        self._rows.append(curvature.row)
        self._columns.append(curvature.col)
        self._values.append(curvature.data)

    def add_residuals(self, unknowns: Rows, jacobian: Floats, residuals: Floats, information: Floats) -> None:
        """Adds squares of (M,) residuals with an (M, N) Jacobian in N unknowns and (M, M) information."""
        weighted = jacobian.T @ information
        self.add(unknowns, weighted @ jacobian, weighted @ residuals)

    def add_differences(self, these: Rows, those: Rows, gaps: Floats, precisions: Floats) -> None:
        """Adds that some unknowns are alike to others: (N,) differences now, and how precisely."""
        for rows, columns, sign in (
            (these, these, 1.0),
            (those, those, 1.0),
            (these, those, -1.0),
            (those, these, -1.0),
        ):
            self._rows.append(rows)
            self._columns.append(columns)
            self._values.append(sign * precisions)
        np.add.at(self._gradient, these, precisions * gaps)
        np.add.at(self._gradient, those, -precisions * gaps)

    def solve(self, photos: int = 0) -> tuple[scipy.sparse.linalg.SuperLU, Floats]:
        """Returns the factorised curvature, and the step to the minimum; the first unknowns are of photos."""
        where = np.concatenate(self._rows), np.concatenate(self._columns)
        matrix = scipy.sparse.csc_matrix(
            scipy.sparse.coo_matrix((np.concatenate(self._values), where), (self._size, self._size))
        )
        # Positive definite: no pivots. Photos come first, each tied to few others, what all share last: for
        # many photos no order is much better, and to look for one takes 30 times as long as all else (500).
        order = "NATURAL" if 2 * photos > self._size else "MMD_AT_PLUS_A"
        factorised = scipy.sparse.linalg.splu(
            matrix, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        return factorised, -factorised.solve(self._gradient)
