"""From a network's logits to the probability that is thresholded (paper, section 3.2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError, QueryFault, nearest_names

# A part is kept where this share of its pixels is sure, if the setting asks for it.
_SURE_SHARE = 0.1
NORMALISATIONS = ("paper", "none")
# A photo whose likeliest pixel is less likely than this shows no building: stretching it would invent one.
_LEAST_PEAK = 0.5


def check_normalise(value: str) -> None:
    """Makes sure that a normalisation is known.

    Raises:
        ConfigError: It is not.
    """
    if value not in NORMALISATIONS:
        raise ConfigError(f"segmenter.normalise={value} is not known.", nearest_names(value, NORMALISATIONS))


def probability_of(logits: NDArray[np.float32], normalise: str) -> NDArray[np.float32]:
    """Returns (H, W) float32 probabilities in [0, 1].

    Args:
        logits: (H, W).
        normalise: ``none``: the sigmoid; ``paper``: stretched to 0 to 1 per photo after it, as the
            released code does, except where no pixel reaches 0.5, which that would turn into noise, or
            where none falls below it.

    Raises:
        QueryFault: Some are NaN.
    """
    if np.isnan(logits).any():
        raise QueryFault("the network's answer holds NaN", "Its weights are damaged, or too large for it.")
    with np.errstate(over="ignore"):
        probability = (1.0 / (1.0 + np.exp(-logits.astype(np.float64)))).astype(np.float32)
    if normalise == "none":
        return probability
    low, high = float(probability.min()), float(probability.max())
    if high < _LEAST_PEAK or low >= _LEAST_PEAK or high - low < 1e-6:
        return probability
    return (probability - np.float32(low)) / np.float32(high - low)


def without_unsure_parts(probability: NDArray[np.float32], sure: float) -> NDArray[np.float32]:
    """Returns (H, W) probabilities, halved in the parts above 0.5 of which hardly a pixel is sure.

    Bare ground that a network takes for buildings it takes for ones half-heartedly; of a real building some
    part convinces it.

    Args:
        probability: (H, W) in [0, 1].
        sure: A tenth of a part must be at least so probable; 0 keeps all.
    """
    import cv2

    count, parts = cv2.connectedComponents((probability >= _LEAST_PEAK).astype(np.uint8))
    sizes = np.bincount(parts.ravel(), minlength=count)
    convincing = np.bincount(parts.ravel(), probability.ravel() >= sure, count)
    is_unsure = convincing < _SURE_SHARE * sizes
    is_unsure[0] = False
    return np.where(is_unsure[parts], np.float32(0.5) * probability, probability)
