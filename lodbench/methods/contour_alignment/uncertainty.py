"""How sure an estimate is: its covariance, and the probability that it is within 2 m and 2 degrees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.methods.contour_alignment.alignment import Linearization
from lodbench.methods.contour_alignment.pose_vector import turn_per_angle
from lodbench.storage import random_stream

Floats = NDArray[np.float64]

# What the probability is of.
WITHIN_M, WITHIN_DEG = 2.0, 2.0
# Draws of the error: enough for a probability to a percent or two.
_DRAWS = 2048


def covariance(at: Linearization) -> Floats:
    """Returns the (6, 6) covariance of x, y, z (metres), pitch, roll and yaw (degrees)."""
    inverse = np.linalg.inv(at.information)
    return np.asarray(0.5 * (inverse + inverse.T))


def probability_within(covariance_6: Floats, vector: Floats) -> float:
    """Returns the probability that an estimate with a Gaussian error lies within (2 m, 2 deg).

    Args:
        covariance_6: (6, 6) as from ``covariance``.
        vector: (6,) the estimate.
    """
    values, axes = np.linalg.eigh(covariance_6)
    errors = _standard_errors() @ (axes * np.sqrt(np.maximum(values, 0.0))).T
    away = np.linalg.norm(errors[:, :3], axis=1)
    turned = np.linalg.norm(errors[:, 3:] @ turn_per_angle(vector).T, axis=1)
    return float(np.mean((away < WITHIN_M) & (turned < WITHIN_DEG)))


def _standard_errors() -> Floats:
    # The same draws for every query: the answer is a function of the covariance alone.
    return random_stream(0, "probability within").standard_normal((_DRAWS, 6))
