"""How outlines err: the noise of a mask's outline, and the covariance of its points' distances.

A mask's outline leans over tens of pixels, so near points say the same twice. Roofs and bases err building by
building.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.kernels.estimation import error_covariance

Floats = NDArray[np.float64]

# The noise is estimated from points nearer than this, and is never less or more than that, pixels.
FAR_PX = 20.0
NOISE_PX = (0.5, 6.0)
# Points that agree less with the mask's direction say nothing about its noise.
_AGREES = 0.3
# Share of the outline's variance that each point has for itself.
_OWN_SHARE = 0.3
# A point that weighs less than this has a variance that no factorisation feels.
LEAST_WEIGHT = 1e-8


def near_distances(distances: Floats, agreement: Floats) -> Floats:
    """Returns those distances that the noise of an outline is estimated from; both are (N,)."""
    return np.asarray(distances[(agreement > _AGREES) & (np.abs(distances) < FAR_PX)])


def outline_noise(near: Floats) -> float:
    """Returns the standard deviation of a mask's outline in pixels, from the median distance.

    Eq. (C8) of docs/methods/contour_alignment.md.

    Args:
        near: (N,) pixels, from ``near_distances``, less what is known to be shared.
    """
    low, high = NOISE_PX
    return float(np.clip(1.4826 * np.median(np.abs(near)), low, high)) if len(near) else high


def outline_covariance(
    pixels: Floats,
    by_roof: Floats,
    by_base: Floats,
    buildings: NDArray[np.int64],
    noise_px: float,
    lengths_px: tuple[float, float],
    errors_m2: tuple[float, float, float],
) -> Floats:
    """Returns the lower half of the covariance of N distances, (N, N) square pixels.

    Eqs. (C6), (C7) of docs/methods/contour_alignment.md.

    Args:
        pixels: (N, 2) the points.
        by_roof: (N,) how distances change per metre that the building's roof is higher.
        by_base: (N,) the same of its base.
        buildings: (N,) which.
        noise_px: Standard deviation of the outline.
        lengths_px: Over which its errors go together, and those of a roof.
        errors_m2: Variances of a roof as a whole, by parts, and of a base.
    """
    noise = (1.0 - _OWN_SHARE) * noise_px**2, _OWN_SHARE * noise_px**2
    slopes = np.ascontiguousarray(by_roof), np.ascontiguousarray(by_base)
    return np.asarray(error_covariance(pixels, *slopes, buildings, noise, lengths_px, errors_m2))


def add_outliers(covariance: Floats, noise_px: float, weights: Floats) -> None:
    """Adds the own errors of outliers to the diagonal of a covariance, for weights (N,) in (0, 1]."""
    covariance[np.diag_indices(len(covariance))] += noise_px**2 * (1.0 / weights - 1.0)
