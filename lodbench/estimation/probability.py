"""Gaussians of state vectors, and the probability that an answer is within 2 m and 2 degrees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry.pose import turn_per_angle
from lodbench.storage import random_stream

Floats = NDArray[np.float64]

# What the probability is of.
WITHIN_M, WITHIN_DEG = 2.0, 2.0
# An answer less probable than this is more likely wrong.
TRUSTED = 0.5
# Draws of the error: enough for a probability to a percent or two.
DRAWS = 2048
_NUMBERS = (("x", "m"), ("y", "m"), ("z", "m"), ("pitch", "deg"), ("roll", "deg"), ("yaw", "deg"))


class Gaussian(NamedTuple):
    """A Gaussian of state vectors.

    Attributes:
        mean: (N,).
        covariance: (N, N).
    """

    mean: Floats
    covariance: Floats

    def root(self) -> Floats:
        """Returns (N, N) a square root of the covariance: it times its transpose is that."""
        squares, axes = np.linalg.eigh(self.covariance)
        return np.asarray(axes * np.sqrt(np.maximum(squares, 0.0)))


def probability_within(covariance_6: Floats, vector: Floats) -> float:
    """Returns the probability that an estimate with a Gaussian error lies within (2 m, 2 deg).

    Eq. (M4) of docs/methods/index.md.

    Args:
        covariance_6: (6, 6) of x, y, z (metres), pitch, roll and yaw (degrees).
        vector: (6,) the estimate.
    """
    errors = fixed_draws(covariance_6, DRAWS)
    return share_within(errors, np.full(DRAWS, 1.0 / DRAWS), turn_per_angle(vector))


def beyond_range(offset: Floats, covariance: Floats, half_widths: Sequence[float]) -> tuple[str, ...]:
    """Returns a sentence for an answer beyond the declared range of the prior, or nothing.

    Args:
        offset: (6,) of the answer from the prior: metres and degrees.
        covariance: (6, 6) of the answer.
        half_widths: Of the range, in the same order.
    """
    beyond = np.abs(offset) - np.asarray(half_widths)
    # Twice what the answer may be wrong by: on the edge of the range it is no news.
    is_out = beyond > np.maximum(2.0 * np.sqrt(np.diagonal(covariance)), (1.0, 1.0, 1.0, 0.5, 0.5, 0.5))
    out = [f"{name} {offset[k]:+.1f} {unit}" for k, (name, unit) in enumerate(_NUMBERS) if is_out[k]]
    if not out:
        return ()
    return (f"the pose lies outside the stated range of the prior: {', '.join(out)}",)


def fixed_draws(covariance_6: Floats, count: int) -> Floats:
    """Returns (count, 6) draws of a Gaussian error without mean; at most 2,056, the same each time."""
    # The same draws for every query: the answer is a function of the covariances alone.
    standard = random_stream(0, "probability within").standard_normal((DRAWS + 8, 6))[:count]
    return np.asarray(standard @ Gaussian(np.zeros(6), covariance_6).root().T)


def share_within(errors: Floats, shares: Floats, turn: Floats) -> float:
    """Returns the share of errors that are within 2 m and 2 degrees.

    Args:
        errors: (N, 6) metres and degrees.
        shares: (N,) of each.
        turn: (3, 3) from ``turn_per_angle``.
    """
    away = np.linalg.norm(errors[:, :3], axis=1)
    turned = np.linalg.norm(errors[:, 3:] @ turn.T, axis=1)
    return min(1.0, float(shares[(away < WITHIN_M) & (turned < WITHIN_DEG)].sum()))


def is_near(error: Floats, turn: Floats) -> bool:
    """Returns whether an error, (6,), is within 2 m and 2 degrees; ``turn`` as of ``share_within``."""
    return bool(np.linalg.norm(error[:3]) < WITHIN_M and np.linalg.norm(turn @ error[3:]) < WITHIN_DEG)
