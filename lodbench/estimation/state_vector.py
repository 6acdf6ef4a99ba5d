"""The state vector that is estimated from a photo: its columns, its prior, the probability that it is right.

A state vector is a pose (metres, degrees), by how many percent the focal length is longer than declared, and
three offsets of the map, metres: all roofs and all bases (higher), all overhangs of eaves (farther out).
Shorter vectors are its beginning. Derivatives of outlines have their columns in the same order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import wrap_deg
from lodbench.geometry.angles import rotations_from_euler
from lodbench.geometry.pose import turn_per_angle
from lodbench.storage import random_stream

Floats = NDArray[np.float64]

# Columns: the pose, the focal length, the offsets of all roofs, bases and overhangs; pitch and roll.
POSE, FOCAL, ALL_ROOFS, ALL_BASES, ALL_OVERHANGS, TILT = slice(0, 6), 6, 7, 8, 9, slice(3, 5)
# Numbers of columns up to the pose, the focal length, all roofs, all bases, and all; and after the pose.
NUM_POSE, NUM_POSE_AND_FOCAL, NUM_WITH_ROOFS, NUM_WITH_BASES, NUM_STATE = range(6, 11)
NUM_AFTER_POSE = NUM_STATE - NUM_POSE
# The longest step of an optimizer (metres, degrees, percent): a linearisation is inexact beyond it.
_LONGEST_STEP = np.array([6.0, 6.0, 10.0, 2.0, 2.0, 4.0, 2.0])


def differences(vectors: Floats, origin: Floats) -> Floats:
    """Returns (..., N) the differences of vectors from an origin or origins, yaw within half a turn."""
    away = np.asarray(vectors - origin)
    away[..., 5] = wrap_deg(away[..., 5])
    return away


def shortened(step: Floats) -> Floats:
    """Returns steps of pose, or pose and focal length, (..., 6 or 7), none longer than the longest step."""
    longest = _LONGEST_STEP[: step.shape[-1]]
    too_long = np.max(np.abs(step) / longest, axis=-1, keepdims=True, initial=0.0)
    return np.asarray(step * (1.0 / np.maximum(1.0, too_long)))


def views_of(vectors: Floats) -> tuple[Floats, Floats]:
    """Returns rotations (N, 3, 3) and centres (N, 3), metres, for drawing with the declared focal length.

    A longer focal length scales the picture's x and y, and so do the first two rows of the rotation when they
    are scaled: views of many focal lengths are drawn with the declared one. Vectors are (N, 6) poses, or
    longer, with the focal length.
    """
    rotations = rotations_from_euler(vectors[:, 3:6])
    # For poses alone the slice is empty, and its sum 0.
    rotations[:, :2] *= 1.0 + 0.01 * vectors[:, FOCAL:NUM_POSE_AND_FOCAL].sum(axis=1)[:, None, None]
    return rotations, np.ascontiguousarray(vectors[:, :3])


# Standard deviations beyond the end of the declared range, of x, y, z, pitch, roll and yaw, in half widths of
# it: larger for numbers whose range is often declared too narrow.
_SOFT_END_SIGMAS = np.array([1.0, 1.0, 0.1, 0.1, 0.1, 0.5])
# Hard bounds of the same, and the standard deviation beyond them, in half widths: the likelihood of dependent
# pixels outweighs any softer end, and from far below some roof splits nearly every photo well.
_HARD_BOUNDS, _HARD_BOUND_SIGMA = np.array([np.inf, np.inf, 1.3, 5.0, 5.0, 2.5]), 0.02


class Prior:
    """A Gaussian of vectors of N numbers with independent errors.

    Args:
        mean: (N,) its mean: a pose, and other numbers that are estimated.
        sigmas: (N,) standard deviations, none 0.
        half_widths: (6,) half widths of the declared range of poses, if its ends count; N is 6 then.
    """

    def __init__(self, mean: Floats, sigmas: Floats, half_widths: Floats | None = None) -> None:
        self.mean, self.sigmas, self._range = mean, sigmas, half_widths

    def offsets(self, vectors: Floats) -> Floats:
        """Returns (..., N) the differences of vectors from its mean; yaw within half a turn."""
        return differences(vectors, self.mean)

    @property
    def precision(self) -> Floats:
        """Returns (N,) the inverse of its variances."""
        return np.asarray(self.sigmas**-2.0)

    def information(self) -> Floats:
        """Returns (N, N) the inverse of its covariance."""
        return np.diag(self.precision)

    def log_density(self, vectors: Floats) -> Floats:
        """Returns the (M,) log-density at vectors (M, N), up to a constant.

        Eq. (R7) of docs/methods/region.md.
        """
        away = self.offsets(vectors)
        squares = (away / self.sigmas) ** 2
        if self._range is not None:
            bounds, bound_sigmas = _HARD_BOUNDS * self._range, _HARD_BOUND_SIGMA * self._range
            beyond_range = np.maximum(np.abs(away) - self._range, 0.0) / (_SOFT_END_SIGMAS * self._range)
            beyond_bounds = np.maximum(np.abs(away) - bounds, 0.0) / bound_sigmas
            squares = squares + beyond_range**2 + beyond_bounds**2
        return np.asarray(-0.5 * squares.sum(axis=-1))


# The errors that a stated probability is about: metres, degrees.
WITHIN_M, WITHIN_DEG = 2.0, 2.0
# Answers of a lower probability are more likely wrong than right.
TRUSTED = 0.5
# Number of draws of an error: a probability is exact to a percent or two.
DRAWS = 2048
_NUMBERS = (("x", "m"), ("y", "m"), ("z", "m"), ("pitch", "deg"), ("roll", "deg"), ("yaw", "deg"))


class Gaussian(NamedTuple):
    """A Gaussian of the first N numbers of a state vector: mean (N,), covariance (N, N)."""

    mean: Floats
    covariance: Floats

    def root(self) -> Floats:
        """Returns (N, N) a square root of the covariance: its product with its transpose."""
        squares, axes = np.linalg.eigh(self.covariance)
        return np.asarray(axes * np.sqrt(np.maximum(squares, 0.0)))


def probability_within(covariance_6: Floats, vector: Floats) -> float:
    """Returns the probability that an estimate, (6,), with a Gaussian error lies within (2 m, 2 deg).

    Eq. (M4) of docs/methods/index.md; (6, 6) of x, y, z (metres), pitch, roll and yaw (degrees).
    """
    errors = fixed_draws(covariance_6, DRAWS)
    return weight_within(errors, np.full(DRAWS, 1.0 / DRAWS), turn_per_angle(vector))


def beyond_range(offset: Floats, covariance: Floats, half_widths: Sequence[float]) -> tuple[str, ...]:
    """Returns a sentence for an answer beyond the declared range of the prior, or nothing.

    Its offset from the prior, (6,) metres and degrees, its covariance and the range's half widths go alike.
    """
    beyond = np.abs(offset) - np.asarray(half_widths)
    # Two standard deviations of the answer: less may be chance.
    is_out = beyond > np.maximum(2.0 * np.sqrt(np.diagonal(covariance)), (1.0, 1.0, 1.0, 0.5, 0.5, 0.5))
    out = [f"{name} {offset[k]:+.1f} {unit}" for k, (name, unit) in enumerate(_NUMBERS) if is_out[k]]
    if not out:
        return ()
    return (f"the pose lies outside the stated range of the prior: {', '.join(out)}",)


def fixed_draws(covariance_6: Floats, count: int) -> Floats:
    """Returns (count, 6) draws of a Gaussian error of mean 0; at most 2,056, the same each time."""
    # The same draws for every query: the answer is a function of the covariances alone.
    standard = random_stream(0, "probability within").standard_normal((DRAWS + 8, 6))[:count]
    return np.asarray(standard @ Gaussian(np.zeros(6), covariance_6).root().T)


def weight_within(errors: Floats, weights: Floats, turn: Floats) -> float:
    """Returns the weight of errors, (N, 6), within 2 m and 2 degrees; ``turn`` is from ``turn_per_angle``."""
    away = np.linalg.norm(errors[:, :3], axis=1)
    turned = np.linalg.norm(errors[:, 3:] @ turn.T, axis=1)
    return min(1.0, float(weights[(away < WITHIN_M) & (turned < WITHIN_DEG)].sum()))


def is_near(error: Floats, turn: Floats) -> bool:
    """Returns whether an error, (6,), is within 2 m and 2 degrees; ``turn`` is from ``turn_per_angle``."""
    return bool(np.linalg.norm(error[:3]) < WITHIN_M and np.linalg.norm(turn @ error[3:]) < WITHIN_DEG)
