"""Covariance matrix adaptation: a maximum of six numbers, from values alone.

The objective is a count of pixels: it has no derivatives, steps of its own below a pixel, and valleys where
tilt and place make up for each other. A Gaussian cloud of poses that learns the valley's shape from its
better half walks along it (Hansen, "The CMA Evolution Strategy: A Tutorial", 2016; the constants are his).
"""

from __future__ import annotations

import math
from collections.abc import Callable
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
    size, parents = len(start.mean), population // 2
    weights = math.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    weights /= weights.sum()
    effective = float(1.0 / (weights**2).sum())
    path_rate = (effective + 2.0) / (size + effective + 5.0)
    damping = 1.0 + path_rate + 2.0 * max(0.0, math.sqrt((effective - 1.0) / (size + 1.0)) - 1.0)
    shape_rate = (4.0 + effective / size) / (size + 4.0 + 2.0 * effective / size)
    rank_one = 2.0 / ((size + 1.3) ** 2 + effective)
    rank_many = min(
        1.0 - rank_one, 2.0 * (effective - 2.0 + 1.0 / effective) / ((size + 2.0) ** 2 + effective)
    )
    length = math.sqrt(size) * (1.0 - 1.0 / (4.0 * size) + 1.0 / (21.0 * size**2))
    mean, shape, scale = start.mean.copy(), start.covariance.copy(), 1.0
    path, shape_path = np.zeros(size), np.zeros(size)
    for generation in range(1, generations + 1):
        squares, axes = np.linalg.eigh(shape)
        spread = np.sqrt(np.maximum(squares, 1e-20))
        half = generator.standard_normal((parents, size))
        moves = np.concatenate([half, -half]) * spread @ axes.T
        best = np.argsort(-value(mean + scale * moves), kind="stable")[:parents]
        step = weights @ moves[best]
        mean = mean + scale * step
        path = (1.0 - path_rate) * path + math.sqrt(path_rate * (2.0 - path_rate) * effective) * (
            axes @ (axes.T @ step / spread)
        )
        norm = float(np.linalg.norm(path))
        is_steady = (
            norm / math.sqrt(1.0 - (1.0 - path_rate) ** (2 * generation)) < (1.4 + 2.0 / (size + 1)) * length
        )
        shape_path = (1.0 - shape_rate) * shape_path
        if is_steady:
            shape_path = shape_path + math.sqrt(shape_rate * (2.0 - shape_rate) * effective) * step
        shape = (
            (1.0 - rank_one - rank_many) * shape
            + rank_one * np.outer(shape_path, shape_path)
            + rank_many * (moves[best].T * weights) @ moves[best]
        )
        scale *= math.exp(path_rate / damping * (norm / length - 1.0))
    return Cloud(mean, scale**2 * shape)
