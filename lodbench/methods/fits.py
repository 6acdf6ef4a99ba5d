"""The fits a method can be told to use, by name: made from a query's building probabilities.

iou: the paper's. soft_iou: with the probabilities as they are. confident_iou: the mask, each pixel weighted
by how sure the network is. boundary: chamfer distance of outlines.
"""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import QueryFault
from lodbench.plugins import load_plugin
from lodbench.rendering import BoundaryFit, Fit, IouFit, SoftIouFit
from lodbench.segmentation import BUILDING_THRESHOLD, resized

Probability = NDArray[np.float32]


def iou(probability: Probability) -> Fit:
    """Returns the intersection over union with the mask."""
    return IouFit(probability >= BUILDING_THRESHOLD)


def confident_iou(probability: Probability) -> Fit:
    """Returns the IoU with the mask, pixels weighted by ``|2 p - 1|``.

    Raises:
        QueryFault: All weights are 0.
    """
    # A pixel that the network cannot tell counts for nothing; on a mask of 0 and 1 this is the IoU.
    confidence = np.abs(2.0 * probability.astype(np.float64) - 1.0)
    if not confidence.any():
        raise QueryFault("the mask is 0.5 everywhere: it says nothing")
    return SoftIouFit((probability >= BUILDING_THRESHOLD).astype(np.float64), confidence)


def boundary(probability: Probability) -> Fit:
    """Returns the chamfer similarity to the mask's outline."""
    return BoundaryFit(probability >= BUILDING_THRESHOLD)


def make_fit(name: str, probability: Probability, size: tuple[int, int]) -> Fit:
    """Returns the fit of a name for a query, at a working size (width, height) in pixels.

    Args:
        name: An entry point under ``lodbench.fits``, which makes a fit of a probability.
        probability: (H, W) probability of building, any size of the photo's aspect.
        size: Width and height of the silhouettes to compare.

    Raises:
        ConfigError: There is no such fit, or it is broken.
        QueryFault: No pixel is more likely building than not.
    """
    make = load_plugin("fits", name)
    # Averaging in float32 may step out of [0, 1] by rounding.
    small = np.clip(resized(probability, *size), np.float32(0), np.float32(1))
    if not (small >= BUILDING_THRESHOLD).any():
        raise QueryFault("the mask holds no building")
    return cast(Fit, make(small))
