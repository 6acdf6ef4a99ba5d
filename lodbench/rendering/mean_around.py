"""The mean of a picture around each pixel, over a good part of its width."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# A mean changes slowly: it is taken of a picture so small that its kernel is this wide, pixels. At the
# borders it is then the exact one to a fiftieth of the picture's deviation, elsewhere to a five-hundredth.
_KERNEL_PX = 16.0


def mean_around(picture: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """Returns the Gaussian mean around each pixel of an (H, W) picture."""
    height, width = picture.shape
    smaller = max(1, int(sigma_px / _KERNEL_PX))
    if smaller == 1 or min(height, width) < 2 * smaller:
        return np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma_px), dtype=np.float32)
    small = cv2.resize(picture, (width // smaller, height // smaller), interpolation=cv2.INTER_AREA)
    mean = cv2.GaussianBlur(small, (0, 0), sigma_px / smaller)
    return np.asarray(cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float32)
