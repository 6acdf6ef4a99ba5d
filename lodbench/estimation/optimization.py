"""Optimization: quadratics, sparse normal equations, groups of errors of one scale, and CMA-ES.

The errors of a group may be declared too large by one unknown factor (variance components): those of roofs
of the map, or of positions in a reconstruction. A flight determines it. Where residuals are smaller than
declared, expectation maximisation lowers the declared standard deviation until its square is the mean square
of the residuals plus their posterior variance (Dempster, Laird and Rubin 1977, section 4.4).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.estimation.state_vector import Gaussian

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]


class Quadratic(NamedTuple):
    """The logarithm of a density of N numbers to second order."""

    information: Floats  # (N, N) the curvature of its negative
    gradient: Floats  # (N,) the slope of its negative
    log_density: float = 0.0  # at the point of linearisation, up to a constant

    def times_prior(self, precision: Floats, away: Floats) -> Quadratic:
        """Returns the product with a prior of independent errors: (N,) precision, and (N,) off its mean."""
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
        """Adds that some unknowns equal others: (N,) present differences, and the precisions of equality."""
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
        # Positive definite: no pivots. Unknowns of photos, each tied to few others, come first, common ones
        # last: for many photos no order is much better, and finding one takes 30 times as long as the rest
        # (500 photos).
        order = "NATURAL" if 2 * photos > self._size else "MMD_AT_PLUS_A"
        factorised = scipy.sparse.linalg.splu(
            matrix, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        return factorised, -factorised.solve(self._gradient)


# Number of random sign vectors that estimate the trace of the posterior covariance (Hutchinson 1990).
_PROBES = 24
# The least scale of errors, relative to the declared one; the largest is 1.
_LEAST_SCALE = 0.1
# The number of errors that the declared scale counts for.
_DECLARED_COUNT = 5.0
# The largest factor by which a step of expectation maximisation is lengthened.
_LONGEST = 4.0
# The least information along any direction, as a fraction of the trace and absolute.
_SINGULAR, _LEAST_INFORMATION = 1e-12, 1e-30


@dataclass(slots=True, eq=False)
class ErrorGroup:
    """Residuals of the normal equations whose standard deviations share one unknown scale."""

    equations: NormalEquations  # the normal equations that they are added to
    scale: float  # present estimate of their standard deviation, relative to the declared one
    count: int = 0  # number of residuals so far
    _rows: list[Rows] = field(default_factory=list)
    _columns: list[Rows] = field(default_factory=list)
    _slopes: list[Floats] = field(default_factory=list)
    _residuals: list[Floats] = field(default_factory=list)

    def add_residuals(self, unknowns: Rows, jacobian: Floats, residuals: Floats, information: Floats) -> None:
        """Adds (M,) residuals with an (M, N) Jacobian in N unknowns and (M, M) information at the scale."""
        self.equations.add_residuals(unknowns, jacobian, residuals, information)
        # Photos from one position do not determine the direction between them: singular matrices need a root.
        least = max(_SINGULAR * float(np.trace(information)), _LEAST_INFORMATION)
        root = np.linalg.cholesky(information + least * np.eye(len(information))).T
        rows = np.repeat(self.count + np.arange(len(residuals)), len(unknowns))
        self._record(rows, np.tile(unknowns, len(residuals)), (root @ jacobian).ravel(), root @ residuals)

    def add_differences(self, these: Rows, those: Rows, gaps: Floats, precisions: Floats) -> None:
        """Adds that unknowns equal others: (N,) present differences, and precisions at the scale."""
        self.equations.add_differences(these, those, gaps, precisions)
        roots, rows = np.sqrt(precisions), self.count + np.arange(len(gaps))
        columns, slopes = np.concatenate([these, those]), np.concatenate([roots, -roots])
        self._record(np.tile(rows, 2), columns, slopes, roots * gaps)

    def scale_after(self, factorised: scipy.sparse.linalg.SuperLU, step: Floats, members: int) -> float:
        """Returns the scale that a solution calls for. Eq. (F12) of docs/methods/flight.md.

        Of (S,) steps of all unknowns; ``members`` errors have nothing to do with each other.
        """
        if self.count == 0:
            return self.scale
        where = np.concatenate(self._rows), np.concatenate(self._columns)
        whitened = scipy.sparse.csr_matrix(
            scipy.sparse.coo_matrix((np.concatenate(self._slopes), where), (self.count, len(step)))
        )
        residuals = np.concatenate(self._residuals) + whitened @ step
        # The same signs each time: the answer is deterministic.
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (self.count, _PROBES))
        probes = whitened.T @ signs
        left_open = float((probes * factorised.solve(probes)).sum()) / _PROBES / self.count
        square = float(residuals @ residuals) / self.count + left_open
        # Expectation maximisation goes a share of the way, less the more is left open: the rest is added.
        power = 0.5 / max(1.0 - left_open**2, 1.0 / _LONGEST)
        scale = self.scale * square**power
        return float(np.clip(scale ** (members / (members + _DECLARED_COUNT)), _LEAST_SCALE, 1.0))

    def _record(self, rows: Rows, columns: Rows, slopes: Floats, residuals: Floats) -> None:
        self._rows.append(rows)
        self._columns.append(columns)
        self._slopes.append(slopes)
        self._residuals.append(residuals)
        self.count += len(residuals)


# The generation after which searches that are far behind end.
_PRUNE_AFTER = 4


def maximize(
    value: Callable[[Floats], Floats],
    start: Gaussian,
    generations: int,
    population: int,
    generator: np.random.Generator,
) -> Gaussian:
    """Returns the Gaussian of the last generation of a maximisation by CMA-ES; its mean is the estimate.

    Args:
        value: from (M, N) points to (M,) values, higher is better.
        start: the Gaussian of the first generation.
        generations: number of generations.
        population: number of points in each, even: every draw is used with both signs.
        generator: the random generator.
    """
    (gaussian,) = maximize_abreast(value, [start], generations, population, [generator])
    return gaussian


def maximize_abreast(
    value: Callable[[Floats], Floats],
    starts: Sequence[Gaussian],
    generations: int,
    population: int,
    generators: Sequence[np.random.Generator],
    prune_gap: float = math.inf,
) -> list[Gaussian]:
    """Returns the results of ``maximize`` from some starts, whose values are evaluated together, in order.

    Searches end, and have no result, if after four generations their best value is lower than the highest of
    all by more than ``prune_gap``.

    Raises:
        ValueError: There are not as many generators as starts.
    """
    if len(starts) != len(generators):
        raise ValueError(f"{len(starts)} starts need as many generators, not {len(generators)}.")
    if not starts:
        return []
    searches = _CmaEs(starts, population)
    for generation in range(generations):
        values = value(searches.draw(generators).reshape(-1, searches.size)).reshape(len(generators), -1)
        searches.update(values)
        if generation + 1 == _PRUNE_AFTER and not math.isinf(prune_gap):
            best = values.max(axis=1)
            # In this form no search ends because of a value that is not a number.
            kept = np.flatnonzero(~(best < best.max() - prune_gap))
            searches, generators = searches.selected(kept), [generators[int(k)] for k in kept]
    return searches.gaussians()


class _CmaEs:
    """W searches by CMA-ES (Hansen 2016, with mirrored draws), a generation at a time."""

    def __init__(self, starts: Sequence[Gaussian], population: int) -> None:
        self._means = np.stack([start.mean for start in starts])
        self._shapes = np.stack([start.covariance for start in starts])
        many, self.size = self._means.shape
        size, parents = self.size, population // 2
        weights = math.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
        self._parents, self._weights = parents, weights / weights.sum()
        self._effective = effective = float(1.0 / (self._weights**2).sum())
        self._path_rate = (effective + 2.0) / (size + effective + 5.0)
        self._damping = (
            1.0 + self._path_rate + 2.0 * max(0.0, math.sqrt((effective - 1.0) / (size + 1.0)) - 1.0)
        )
        self._shape_rate = (4.0 + effective / size) / (size + 4.0 + 2.0 * effective / size)
        self._rank_one = 2.0 / ((size + 1.3) ** 2 + effective)
        self._rank_many = min(
            1.0 - self._rank_one,
            2.0 * (effective - 2.0 + 1.0 / effective) / ((size + 2.0) ** 2 + effective),
        )
        self._length = math.sqrt(size) * (1.0 - 1.0 / (4.0 * size) + 1.0 / (21.0 * size**2))
        self._scales, self._paths, self._shape_paths = np.ones(many), *np.zeros((2, many, size))
        self._generation = 0

    def draw(self, generators: Sequence[np.random.Generator]) -> Floats:
        """Returns the next generation of each search, (W, M, N)."""
        squares, self._axes = np.linalg.eigh(self._shapes)
        self._axis_sigmas = np.sqrt(np.maximum(squares, 1e-20))
        half = np.stack([each.standard_normal((self._parents, self.size)) for each in generators])
        moves = (half * self._axis_sigmas[:, None]) @ self._axes.transpose(0, 2, 1)
        self._moves = np.concatenate([moves, -moves], axis=1)
        return np.asarray(self._means[:, None] + self._scales[:, None, None] * self._moves)

    def update(self, values: Floats) -> None:
        """Updates mean, shape and step size of each search by (W, M) values of its last generation.

        Eq. (R9) of docs/methods/region.md.
        """
        size, effective, path_rate, shape_rate = self.size, self._effective, self._path_rate, self._shape_rate
        order = np.argsort(-values, axis=1, kind="stable")[:, : self._parents]
        best = np.take_along_axis(self._moves, order[..., None], axis=1)
        steps = self._weights @ best
        self._means = self._means + self._scales[:, None] * steps
        along = np.einsum("wij,wi->wj", self._axes, steps) / self._axis_sigmas
        whitened = np.einsum("wij,wj->wi", self._axes, along)
        self._paths = (1.0 - path_rate) * self._paths
        self._paths += math.sqrt(path_rate * (2.0 - path_rate) * effective) * whitened
        norms = np.linalg.norm(self._paths, axis=1)
        self._generation += 1
        settled = math.sqrt(1.0 - (1.0 - path_rate) ** (2 * self._generation))
        is_short = norms / settled < (1.4 + 2.0 / (size + 1)) * self._length
        self._shape_paths = (1.0 - shape_rate) * self._shape_paths
        self._shape_paths += is_short[:, None] * (
            math.sqrt(shape_rate * (2.0 - shape_rate) * effective) * steps
        )
        self._shapes = (
            (1.0 - self._rank_one - self._rank_many) * self._shapes
            + self._rank_one * self._shape_paths[:, :, None] * self._shape_paths[:, None, :]
            + self._rank_many * (best.transpose(0, 2, 1) * self._weights) @ best
        )
        self._scales = self._scales * np.exp(path_rate / self._damping * (norms / self._length - 1.0))

    def selected(self, which: NDArray[np.int64]) -> _CmaEs:
        """Returns some of the searches."""
        others = copy(self)
        for name in ("_means", "_shapes", "_scales", "_paths", "_shape_paths"):
            setattr(others, name, getattr(self, name)[which])
        return others

    def gaussians(self) -> list[Gaussian]:
        """Returns the present Gaussian of each search."""
        shapes = self._scales[:, None, None] ** 2 * self._shapes
        return [Gaussian(mean, shape) for mean, shape in zip(self._means, shapes, strict=True)]
