"""What a photo's own colours say, taught by the pixels of which a network is sure.

A network that has seen no roofs like these is sure of some of them, and of most of the ground. A classifier
of colour and texture that learns from those, on this photo alone, carries it to the rest (docs/adr/0058).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.segmentation.working_size import resized_photo, working_size

Logits = NDArray[np.float32]

# Long side of the picture whose pixels are classified, and over how many colours and textures are averaged.
_SIZE, _BLURS_PX = 300, (1.5, 4.0)
# What a photo without any texture has of it, of L from 0 to 100.
_LEAST_TEXTURE = 0.4
# Logistic regression: its ridge, in pixels, and Newton steps.
_RIDGE, _STEPS = 30.0, 5
# How far the rarer class is raised: 0 leaves shares as the network has them, 1 makes both alike.
_BALANCE = 0.5
# What the classifier says is believed so far, and no class is learnt from fewer sure pixels.
_MOST_LOGIT, _FEWEST = 4.0, 50.0


def adapted(logits: Logits, photo: NDArray[np.uint8], weight: float) -> Logits:
    """Returns the (h, w) logits of building of a network and of the photo's own colours together.

    Test-time adaptation by self-training, of a classifier of pixels beside the network, not of the network.

    Args:
        logits: (h, w) the network's.
        photo: (H, W, 3) RGB, of the same view.
        weight: Of the classifier's logits; the network's lose half as much. 0 leaves them as they are.
    """
    height, width = logits.shape
    small = working_size(width, height, _SIZE)
    probability = scipy.special.expit(
        cv2.resize(logits, small, interpolation=cv2.INTER_AREA).astype(np.float64)
    ).ravel()
    is_building, sureness = probability > 0.5, np.abs(2.0 * probability - 1.0)
    sure = np.array([sureness[~is_building].sum(), sureness[is_building].sum()])
    if weight == 0 or sure.min() < _FEWEST:
        return logits
    weights = sureness * ((0.5 * sure.sum() / sure) ** _BALANCE)[is_building.astype(np.int64)]
    features = _features(resized_photo(photo, *small))
    found = features @ _logistic_regression(features, is_building, weights)
    own = np.clip(found, -_MOST_LOGIT, _MOST_LOGIT).reshape(small[::-1]).astype(np.float32)
    of_photo = cv2.resize(own, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray((1.0 - 0.5 * weight) * logits + weight * of_photo, np.float32)


def _features(photo: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Returns (H * W, K) a constant, and colours and textures around each pixel, of mean 0, deviation 1."""
    lab: Any = cv2.cvtColor(photo.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2LAB)
    edges = np.abs(cv2.Laplacian(lab[..., 0], cv2.CV_32F))
    seen = np.dstack([lab, edges])
    around = [cv2.GaussianBlur(seen, (0, 0), blur_px) for blur_px in _BLURS_PX]
    for each in around:
        each[..., 3] = np.log(_LEAST_TEXTURE + each[..., 3])
    whole = np.dstack(around).reshape(photo.shape[0] * photo.shape[1], -1).astype(np.float64)
    scaled = np.clip((whole - whole.mean(axis=0)) / (whole.std(axis=0) + 1e-3), -3.0, 3.0)
    return np.column_stack([np.ones(len(scaled)), scaled])


def _logistic_regression(
    features: NDArray[np.float64], labels: NDArray[np.bool_], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the (K,) coefficients of (N, K) features, by Newton's method under a ridge."""
    coefficients = np.zeros(features.shape[1])
    ridge = np.full(features.shape[1], _RIDGE)
    for _ in range(_STEPS):
        chances = scipy.special.expit(features @ coefficients)
        curvature = (features.T * (weights * chances * (1.0 - chances))) @ features + np.diag(ridge)
        slope = features.T @ (weights * (labels - chances)) - ridge * coefficients
        coefficients = coefficients + np.linalg.solve(curvature, slope)
    return coefficients
