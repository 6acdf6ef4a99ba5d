"""The fits a method can be told to use, by name: made from a query's building probabilities."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError, QueryFault, nearest_names
from lodbench.rendering import BoundaryFit, Fit, IouFit, SoftIouFit
from lodbench.segmentation import BUILDING_THRESHOLD, resized

Probability = NDArray[np.float32]


def _iou(probability: Probability) -> Fit:
    return IouFit(probability >= BUILDING_THRESHOLD)


def _confident_iou(probability: Probability) -> Fit:
    # A pixel that the network cannot tell counts for nothing; on a mask of 0 and 1 this is the IoU.
    confidence = np.abs(2.0 * probability.astype(np.float64) - 1.0)
    if not confidence.any():
        raise QueryFault("the mask is 0.5 everywhere: it says nothing")
    return SoftIouFit((probability >= BUILDING_THRESHOLD).astype(np.float64), confidence)


def _boundary(probability: Probability) -> Fit:
    return BoundaryFit(probability >= BUILDING_THRESHOLD)


# iou: the paper's. soft_iou: with the probabilities as they are. confident_iou: the mask, each pixel
# weighted by how sure the network is. boundary: chamfer distance of outlines.
FITS: dict[str, Callable[[Probability], Fit]] = {
    "iou": _iou,
    "soft_iou": SoftIouFit,
    "confident_iou": _confident_iou,
    "boundary": _boundary,
}


def require_fit(name: str) -> None:
    """Makes sure that a fit is known.

    Raises:
        ConfigError: It is not.
    """
    if name not in FITS:
        raise ConfigError(f"method.fit={name} is not known.", nearest_names(name, FITS))


def make_fit(name: str, probability: Probability, size: tuple[int, int]) -> Fit:
    """Returns the fit of a name for a query, at a working size (width, height) in pixels.

    Args:
        name: One of ``FITS``.
        probability: (H, W) probability of building, any size of the photo's aspect.
        size: Width and height of the silhouettes to compare.

    Raises:
        ConfigError: The name is unknown.
        QueryFault: No pixel is more likely building than not.
    """
    require_fit(name)
    # Averaging in float32 may step out of [0, 1] by rounding.
    small = np.clip(resized(probability, *size), np.float32(0), np.float32(1))
    if not (small >= BUILDING_THRESHOLD).any():
        raise QueryFault("the mask holds no building")
    return FITS[name](small)
