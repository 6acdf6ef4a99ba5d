"""What is estimated of a photo, as one vector: its columns, its prior, and the probability that it is right.

A vector is a pose (metres, degrees), by how many percent the lens is longer than declared, then metres: how
much higher than in the map all roofs are and where all walls end, and how much farther all eaves stand out.
Shorter vectors begin alike; it is also the order in which an outline says how it moves.
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

POSE, LENS, ROOFS, BASE_OFFSET, EAVE_OFFSET = slice(0, 6), 6, 7, 8, 9
# Of a pose: pitch and roll.
TILT = slice(3, 5)
# How many numbers a vector has: a pose, a camera, one with roofs, one with all that outlines show, all.
POSES, CAMERAS, RAISED, OUTLINES, ALL = range(6, 11)
# What a pose alone leaves out.
BESIDE_POSE = ALL - POSES
# The longest step of an optimizer: a linearisation says little beyond it (metres, degrees, percent).
_LONGEST_STEP = np.array([6.0, 6.0, 10.0, 2.0, 2.0, 4.0, 2.0])


def differences(vectors: Floats, origin: Floats) -> Floats:
    """Returns (..., N) vectors less another one or others, yaw within half a turn."""
    away = np.asarray(vectors - origin)
    away[..., 5] = wrap_deg(away[..., 5])
    return away


def shortened(step: Floats) -> Floats:
    """Returns steps of poses or cameras, (..., 6 or 7), none longer than a linearisation is good for."""
    longest = _LONGEST_STEP[: step.shape[-1]]
    too_long = np.max(np.abs(step) / longest, axis=-1, keepdims=True, initial=0.0)
    return np.asarray(step * (1.0 / np.maximum(1.0, too_long)))


def views_of(vectors: Floats) -> tuple[Floats, Floats]:
    """Returns the rotations (N, 3, 3) and centres (N, 3), metres, that show what some cameras see.

    A longer lens stretches what a camera sees across and down, and so do the first two rows of a rotation
    that are stretched: cameras of many lenses are drawn as if they had the declared one. Vectors are (N, 6)
    poses, or longer with the lens.
    """
    rotations = rotations_from_euler(vectors[:, 3:6])
    # Of poses the slice is empty, and its sum 0.
    rotations[:, :2] *= 1.0 + 0.01 * vectors[:, LENS:CAMERAS].sum(axis=1)[:, None, None]
    return rotations, np.ascontiguousarray(vectors[:, :3])


# How softly a declared range ends, as a share of its half width: x, y, z, pitch, roll and yaw. Softly in what
# is often declared narrower than it is.
_EDGE_SHARES = np.array([1.0, 1.0, 0.1, 0.1, 0.1, 0.5])
# And where it ends for good, in half widths, and how softly there: evidence of pixels that are not
# independent outweighs any softer end, and from far below nearly every photo is parted well by some roof.
_WALLS, _WALL_SHARE = np.array([np.inf, np.inf, 1.3, 5.0, 5.0, 2.5]), 0.02


class Prior:
    """A Gaussian about a state vector of N numbers, with independent errors.

    Args:
        mean: (N,) metres, degrees and what else is estimated.
        sigmas: (N,) standard deviations, none 0.
        half_widths: (6,) of the range of poses that was declared, where its ends count; N is 6 then.
    """

    def __init__(self, mean: Floats, sigmas: Floats, half_widths: Floats | None = None) -> None:
        self.mean, self.sigmas, self._range = mean, sigmas, half_widths

    def offsets(self, vectors: Floats) -> Floats:
        """Returns (..., N) how far vectors are from its mean; yaw within half a turn."""
        return differences(vectors, self.mean)

    @property
    def precision(self) -> Floats:
        """Returns (N,) the inverse of its variances."""
        return np.asarray(self.sigmas**-2.0)

    def information(self) -> Floats:
        """Returns (N, N) the inverse of its covariance."""
        return np.diag(self.precision)

    def log_density(self, vectors: Floats) -> Floats:
        """Returns the (M,) logarithm of its density at vectors (M, N), up to a constant.

        Eq. (R7) of docs/methods/region.md.
        """
        away = self.offsets(vectors)
        squares = (away / self.sigmas) ** 2
        if self._range is not None:
            beyond = np.maximum(np.abs(away) - self._range, 0.0) / (_EDGE_SHARES * self._range)
            through = np.maximum(np.abs(away) - _WALLS * self._range, 0.0) / (_WALL_SHARE * self._range)
            squares = squares + beyond**2 + through**2
        return np.asarray(-0.5 * squares.sum(axis=-1))


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
    """Returns the probability that an estimate, (6,), with a Gaussian error lies within (2 m, 2 deg).

    Eq. (M4) of docs/methods/index.md; (6, 6) of x, y, z (metres), pitch, roll and yaw (degrees).
    """
    errors = fixed_draws(covariance_6, DRAWS)
    return share_within(errors, np.full(DRAWS, 1.0 / DRAWS), turn_per_angle(vector))


def beyond_range(offset: Floats, covariance: Floats, half_widths: Sequence[float]) -> tuple[str, ...]:
    """Returns a sentence for an answer beyond the declared range of the prior, or nothing.

    Its offset from the prior, (6,) metres and degrees, its covariance and the range's half widths go alike.
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
    """Returns the share of errors, (N, 6), within 2 m and 2 degrees; ``turn`` of ``turn_per_angle``."""
    away = np.linalg.norm(errors[:, :3], axis=1)
    turned = np.linalg.norm(errors[:, 3:] @ turn.T, axis=1)
    return min(1.0, float(shares[(away < WITHIN_M) & (turned < WITHIN_DEG)].sum()))


def is_near(error: Floats, turn: Floats) -> bool:
    """Returns whether an error, (6,), is within 2 m and 2 degrees; ``turn`` as of ``share_within``."""
    return bool(np.linalg.norm(error[:3]) < WITHIN_M and np.linalg.norm(turn @ error[3:]) < WITHIN_DEG)
