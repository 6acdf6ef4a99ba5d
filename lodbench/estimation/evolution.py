"""Covariance matrix adaptation: a maximum of six numbers, from values alone.

The objective is a count of pixels: it has no derivatives, steps of its own below a pixel, and valleys where
tilt and place make up for each other. A Gaussian cloud of poses that learns the valley's shape from its
better half moves along it (Hansen, "The CMA Evolution Strategy: A Tutorial", 2016; the constants are his).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from lodbench.estimation.probability import Gaussian

Floats = NDArray[np.float64]

# Generations after which searches that are far behind are given up.
_PRUNE_AFTER = 4


def maximize(
    value: Callable[[Floats], Floats],
    start: Gaussian,
    generations: int,
    population: int,
    generator: np.random.Generator,
) -> Gaussian:
    """Returns the Gaussian of the last of some generations; its mean is the estimate.

    Args:
        value: (M, N) points to (M,) values, higher is better.
        start: Where to begin, and how widely.
        generations: How many.
        population: Points in each, even: every draw is used with both signs.
        generator: Of random numbers.
    """
    (found,) = maximize_abreast(value, [start], generations, population, [generator])
    return found


def maximize_abreast(
    value: Callable[[Floats], Floats],
    starts: Sequence[Gaussian],
    generations: int,
    population: int,
    generators: Sequence[np.random.Generator],
    prune_gap: float = math.inf,
) -> list[Gaussian]:
    """Returns what ``maximize`` does from some starts, evaluated together: of those not given up, in order.

    Args:
        value: As of ``maximize``.
        starts: Where to begin.
        generations: As of ``maximize``.
        population: As of ``maximize``.
        generators: Of random numbers, one for each start.
        prune_gap: Searches whose best is lower than the highest by more after four generations are given up;
            in units of the value.

    Raises:
        ValueError: There are not as many generators as starts.
    """
    if len(starts) != len(generators):
        raise ValueError(f"{len(starts)} starts need as many generators, not {len(generators)}.")
    if not starts:
        return []
    searches = _Searches(starts, population)
    for generation in range(generations):
        values = value(searches.draw(generators).reshape(-1, searches.size)).reshape(len(generators), -1)
        searches.update(values)
        if generation + 1 == _PRUNE_AFTER and not math.isinf(prune_gap):
            best = values.max(axis=1)
            # This way round none is given up where a value is no number.
            kept = np.flatnonzero(~(best < best.max() - prune_gap))
            searches, generators = searches.selected(kept), [generators[int(k)] for k in kept]
    return searches.gaussians()


class _Searches:
    """Some searches, W of them, a generation at a time."""

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
        """Draws the next generation of each, (W, M, N)."""
        squares, self._axes = np.linalg.eigh(self._shapes)
        self._spreads = np.sqrt(np.maximum(squares, 1e-20))
        half = np.stack([each.standard_normal((self._parents, self.size)) for each in generators])
        moves = (half * self._spreads[:, None]) @ self._axes.transpose(0, 2, 1)
        self._moves = np.concatenate([moves, -moves], axis=1)
        return np.asarray(self._means[:, None] + self._scales[:, None, None] * self._moves)

    def update(self, values: Floats) -> None:
        """Moves each towards the better half of its generation drawn last, and learns its shape.

        Eq. (R9) of docs/methods/region.md.

        Args:
            values: (W, M) of the points.
        """
        size, effective, path_rate, shape_rate = self.size, self._effective, self._path_rate, self._shape_rate
        order = np.argsort(-values, axis=1, kind="stable")[:, : self._parents]
        best = np.take_along_axis(self._moves, order[..., None], axis=1)
        steps = self._weights @ best
        self._means = self._means + self._scales[:, None] * steps
        along = np.einsum("wij,wi->wj", self._axes, steps) / self._spreads
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

    def selected(self, which: NDArray[np.int64]) -> _Searches:
        """Returns some of them, between generations."""
        others = copy(self)
        for name in ("_means", "_shapes", "_scales", "_paths", "_shape_paths"):
            setattr(others, name, getattr(self, name)[which])
        return others

    def gaussians(self) -> list[Gaussian]:
        """Returns where each has come to."""
        shapes = self._scales[:, None, None] ** 2 * self._shapes
        return [Gaussian(mean, shape) for mean, shape in zip(self._means, shapes, strict=True)]
