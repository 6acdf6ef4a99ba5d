"""Whether an estimate can be stored and read: asked of a run's rows, and by check-method."""

from __future__ import annotations

import math

import numpy as np

from lodbench.methods.protocol import Estimate

# Rounding may make a covariance uneven, or an eigenvalue negative, by this share of the largest.
_TOLERANCE = 1e-6


def number_fault(estimate: Estimate) -> str:
    """Returns what is wrong with an estimate's times, traces and alternatives' probabilities, or ""."""
    for what, stages in (("seconds", estimate.seconds), ("trace", estimate.trace)):
        if not all(isinstance(stage, str) for stage in stages):
            return f"{what} has a stage whose name is no text"
    numbers = {
        "seconds": list(estimate.seconds.values()),
        "trace": [value for values in estimate.trace.values() for value in values],
        "alternative_probabilities": list(estimate.alternative_probabilities),
    }
    for what, values in numbers.items():
        if not all(math.isfinite(value) for value in values):
            return f"{what} holds a number that is not finite"
    return ""


def uncertainty_fault(estimate: Estimate) -> str:
    """Returns what is wrong with an estimate's probability and covariance, or ""."""
    # NaN compares as false.
    if estimate.probability is not None and not 0.0 <= estimate.probability <= 1.0:
        return f"the probability is {estimate.probability}, not within 0 and 1"
    if estimate.covariance is None:
        return ""
    matrix = np.asarray(estimate.covariance, dtype=np.float64)
    if matrix.shape != (6, 6):
        return f"the covariance is of shape {matrix.shape}, not (6, 6)"
    if not np.isfinite(matrix).all():
        return "the covariance is not finite"
    largest = float(np.abs(matrix).max())
    if np.abs(matrix - matrix.T).max() > _TOLERANCE * largest:
        return "the covariance is not symmetric"
    if np.linalg.eigvalsh(matrix).min() < -_TOLERANCE * largest:
        return "the covariance has a negative eigenvalue"
    return ""


def note_fault(estimate: Estimate) -> str:
    """Returns what is wrong with an estimate's notes, or ""."""
    # One text alone would be stored letter by letter.
    is_sound = isinstance(estimate.notes, tuple | list) and all(isinstance(n, str) for n in estimate.notes)
    return "" if is_sound else "the notes are no tuple of texts"
