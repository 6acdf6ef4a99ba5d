"""The size that a network sees a photo at."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray


def working_size(width: int, height: int, longest: int) -> tuple[int, int]:
    """Returns the width and height of a photo whose long side is ``longest``; never below one pixel."""
    factor = longest / max(width, height)
    return max(1, round(width * factor)), max(1, round(height * factor))


def resized_photo(photo: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Returns a (H, W, 3) photo at another size: averaged where it shrinks, interpolated where it grows."""
    if photo.shape[:2] == (height, width):
        return photo
    shrinks = width * height < photo.shape[0] * photo.shape[1]
    return np.asarray(
        cv2.resize(photo, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR),
        np.uint8,
    )


def padded_photo(
    photo: NDArray[np.uint8], stride: int, mode: Literal["edge", "symmetric"] = "edge"
) -> NDArray[np.uint8]:
    """Returns a photo with its last row and column repeated, or mirrored, up to multiples of a stride."""
    height, width = photo.shape[:2]
    return np.pad(photo, ((0, -height % stride), (0, -width % stride), (0, 0)), mode=mode)
