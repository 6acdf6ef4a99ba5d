"""Least squares: a quadratic and its step, sparse normal equations, groups of errors of one scale.

Errors may be declared too large by one unknown factor, which a flight itself shows (variance components). A
flight says how far roofs of the map differ from each other, and how far photos lie from where a
reconstruction has them. Where that is less than was told beforehand, expectation maximisation lowers what
was told: squares of the residuals, and what is left open of them, are what their variance should be
(Dempster, Laird and Rubin 1977, section 4.4).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]


class Quadratic(NamedTuple):
    """The logarithm of a density of N numbers to second order.

    Attributes:
        information: (N, N) the curvature of its negative.
        gradient: (N,) the slope of its negative.
        log_density: At the point of linearisation, up to a constant.
    """

    information: Floats
    gradient: Floats
    log_density: float = 0.0

    def times_prior(self, precision: Floats, away: Floats) -> Quadratic:
        """Returns the product with a Gaussian prior of independent errors.

        Args:
            precision: (N,) of the prior.
            away: (N,) how far the point is from its mean.
        """
        return Quadratic(
            self.information + np.diag(precision),
            self.gradient + precision * away,
            self.log_density - 0.5 * float(precision @ away**2),
        )

    def step(self) -> Floats:
        """Returns (N,) the Gauss-Newton step to its maximum."""
        return np.asarray(-np.linalg.solve(self.information, self.gradient))


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


# Random signs of which so many tell the trace of what is left open (Hutchinson 1990).
_PROBES = 24
# Errors are never so small a share of what was told, and never larger than told.
_LEAST = 0.1
# What was told counts as so many errors.
_AS_TOLD = 5.0
# Steps are lengthened by no more than this.
_LONGEST = 4.0
# Information is taken for no less along any direction than this share of all, and than this.
_SINGULAR, _NOTHING = 1e-12, 1e-30


@dataclass(slots=True, eq=False)
class ErrorGroup:
    """Residuals of the normal equations that all err by a share of what is told.

    Attributes:
        equations: To which they are added.
        scale: The share as it is thought to be.
        count: Residuals so far.
    """

    equations: NormalEquations
    scale: float
    count: int = 0
    _rows: list[Rows] = field(default_factory=list)
    _columns: list[Rows] = field(default_factory=list)
    _slopes: list[Floats] = field(default_factory=list)
    _residuals: list[Floats] = field(default_factory=list)

    def add_residuals(self, unknowns: Rows, jacobian: Floats, residuals: Floats, information: Floats) -> None:
        """Adds (M,) residuals with an (M, N) Jacobian in N unknowns and (M, M) information at the scale."""
        self.equations.add_residuals(unknowns, jacobian, residuals, information)
        # Photos from one place say nothing of the direction between them: what is singular keeps a root.
        least = max(_SINGULAR * float(np.trace(information)), _NOTHING)
        root = np.linalg.cholesky(information + least * np.eye(len(information))).T
        rows = np.repeat(self.count + np.arange(len(residuals)), len(unknowns))
        self._record(rows, np.tile(unknowns, len(residuals)), (root @ jacobian).ravel(), root @ residuals)

    def add_differences(self, these: Rows, those: Rows, gaps: Floats, precisions: Floats) -> None:
        """Adds that unknowns are alike to others: (N,) differences now, and how precisely at the scale."""
        self.equations.add_differences(these, those, gaps, precisions)
        roots, rows = np.sqrt(precisions), self.count + np.arange(len(gaps))
        columns, slopes = np.concatenate([these, those]), np.concatenate([roots, -roots])
        self._record(np.tile(rows, 2), columns, slopes, roots * gaps)

    def scale_after(self, factorised: scipy.sparse.linalg.SuperLU, step: Floats, members: int) -> float:
        """Returns the scale that a solution calls for. Eq. (F12) of docs/methods/flight.md.

        Args:
            factorised: The curvature.
            step: (S,) of all unknowns.
            members: How many errors have nothing to do with each other: those of one building have.
        """
        if self.count == 0:
            return self.scale
        where = np.concatenate(self._rows), np.concatenate(self._columns)
        whitened = scipy.sparse.csr_matrix(
            scipy.sparse.coo_matrix((np.concatenate(self._slopes), where), (self.count, len(step)))
        )
        residuals = np.concatenate(self._residuals) + whitened @ step
        # The same signs each time: an answer does not depend on chance.
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (self.count, _PROBES))
        probes = whitened.T @ signs
        left_open = float((probes * factorised.solve(probes)).sum()) / _PROBES / self.count
        square = float(residuals @ residuals) / self.count + left_open
        # Expectation maximisation goes a share of the way, less the more is left open: the rest is added.
        power = 0.5 / max(1.0 - left_open**2, 1.0 / _LONGEST)
        found = self.scale * square**power
        return float(np.clip(found ** (members / (members + _AS_TOLD)), _LEAST, 1.0))

    def _record(self, rows: Rows, columns: Rows, slopes: Floats, residuals: Floats) -> None:
        self._rows.append(rows)
        self._columns.append(columns)
        self._slopes.append(slopes)
        self._residuals.append(residuals)
        self.count += len(residuals)
