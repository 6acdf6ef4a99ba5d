"""Covariance matrix adaptation: a maximum of six numbers, from values alone.

The objective is a count of pixels: it has no derivatives, steps of its own below a pixel, and valleys where
tilt and place make up for each other. A Gaussian cloud of poses that learns the valley's shape from its
better half walks along it (Hansen, "The CMA Evolution Strategy: A Tutorial", 2016; the constants are his).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Cloud(NamedTuple):
    """A Gaussian of poses.

    Attributes:
        mean: (N,) its middle.
        covariance: (N, N).
    """

    mean: Floats
    covariance: Floats


def climb(
    value: Callable[[Floats], Floats],
    start: Cloud,
    generations: int,
    population: int,
    generator: np.random.Generator,
) -> Cloud:
    """Returns the cloud after some generations of walking uphill; its mean is the estimate.

    Args:
        value: (M, N) points to (M,) values, higher is better.
        start: Where to begin, and how widely.
        generations: How many.
        population: Points in each, even: every draw is used with both signs.
        generator: Of random numbers.
    """
    (cloud,) = climb_abreast(value, [start], generations, population, [generator])
    return cloud


def climb_abreast(
    value: Callable[[Floats], Floats],
    starts: Sequence[Cloud],
    generations: int,
    population: int,
    generators: Sequence[np.random.Generator],
) -> list[Cloud]:
    """Returns what ``climb`` does from each of some starts, which are asked about together.

    Args:
        value: As of ``climb``.
        starts: Where to begin.
        generations: As of ``climb``.
        population: As of ``climb``.
        generators: Of random numbers, one for each start.
    """
    walkers = [_Walker(*each, population) for each in zip(starts, generators, strict=True)]
    for _ in range(generations if walkers else 0):
        values = value(np.concatenate([walker.points() for walker in walkers]))
        for walker, its in zip(walkers, np.split(values, len(walkers)), strict=True):
            walker.walk(its)
    return [walker.cloud() for walker in walkers]


class _Walker:
    """One climb, a generation at a time."""

    def __init__(self, start: Cloud, generator: np.random.Generator, population: int) -> None:
        self._generator, self._parents = generator, population // 2
        size, parents = len(start.mean), self._parents
        weights = math.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
        self._weights = weights / weights.sum()
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
        self._mean, self._shape, self._scale = start.mean.copy(), start.covariance.copy(), 1.0
        self._path, self._shape_path = np.zeros(size), np.zeros(size)
        self._generation = 0

    def points(self) -> Floats:
        """Draws the next generation, (M, N)."""
        squares, self._axes = np.linalg.eigh(self._shape)
        self._spread = np.sqrt(np.maximum(squares, 1e-20))
        half = self._generator.standard_normal((self._parents, len(self._mean)))
        self._moves = np.concatenate([half, -half]) * self._spread @ self._axes.T
        return np.asarray(self._mean + self._scale * self._moves)

    def walk(self, values: Floats) -> None:
        """Moves towards the better half of the generation drawn last, and learns its shape."""
        size, effective, path_rate = len(self._mean), self._effective, self._path_rate
        best = self._moves[np.argsort(-values, kind="stable")[: self._parents]]
        step = self._weights @ best
        self._mean = self._mean + self._scale * step
        self._path = (1.0 - path_rate) * self._path + math.sqrt(path_rate * (2.0 - path_rate) * effective) * (
            self._axes @ (self._axes.T @ step / self._spread)
        )
        norm = float(np.linalg.norm(self._path))
        self._generation += 1
        settled = math.sqrt(1.0 - (1.0 - path_rate) ** (2 * self._generation))
        shape_rate = self._shape_rate
        self._shape_path = (1.0 - shape_rate) * self._shape_path
        if norm / settled < (1.4 + 2.0 / (size + 1)) * self._length:
            self._shape_path = (
                self._shape_path + math.sqrt(shape_rate * (2.0 - shape_rate) * effective) * step
            )
        self._shape = (
            (1.0 - self._rank_one - self._rank_many) * self._shape
            + self._rank_one * np.outer(self._shape_path, self._shape_path)
            + self._rank_many * (best.T * self._weights) @ best
        )
        self._scale *= math.exp(path_rate / self._damping * (norm / self._length - 1.0))

    def cloud(self) -> Cloud:
        """Returns where it has come to."""
        return Cloud(self._mean, self._scale**2 * self._shape)
