"""Two pictures as networks want them: one size, sides of whole cells, and the way back for what is found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.matching.protocol import Image, check_image

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class PicturePair:
    """Two pictures made smaller by one factor and filled up, below and on the right, to one size.

    Attributes:
        pictures: (2, H, W, 3) float32 RGB in [0, 1].
        factors: (2, 2) x and y of each picture's size against the original's.
        sizes: (2, 2) width and height of the originals, pixels.
    """

    pictures: Floats
    factors: Floats
    sizes: Floats

    def original(self, places: NDArray[np.generic], number: int) -> tuple[Floats, NDArray[np.bool_]]:
        """Returns where places of one of the pictures are in its original, and which of them are in it.

        Args:
            places: (N, 2) with the first pixel's centre at (0, 0), as networks count.
            number: 0 or 1.

        Returns:
            (N, 2) COLMAP pixels, and (N,).
        """
        found = ((np.asarray(places, np.float32) + np.float32(0.5)) / self.factors[number]).astype(np.float32)
        return found, np.asarray(((found >= 0) & (found <= self.sizes[number])).all(axis=1))


def make_pair(first: Image, second: Image, longest_px: int, cell_px: int) -> PicturePair:
    """Returns two pictures ready for a network.

    Args:
        first: (H, W, 3) uint8.
        second: Likewise, of any size.
        longest_px: The longest side of both is at most this.
        cell_px: Sides are multiples of it.

    Raises:
        RenderingError: A picture is no such array.
    """
    import cv2

    images = [check_image(first), check_image(second)]
    scale = min(1.0, longest_px / max(max(image.shape[:2]) for image in images))
    small = []
    for image in images:
        height, width = (max(1, round(side * scale)) for side in image.shape[:2])
        resized = image if scale == 1.0 else cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        small.append(np.asarray(resized))
    tall, wide = (-(-max(image.shape[k] for image in small) // cell_px) * cell_px for k in (0, 1))
    pair = [
        np.pad(image, ((0, tall - image.shape[0]), (0, wide - image.shape[1]), (0, 0)), mode="edge")
        for image in small
    ]
    sizes = np.array([image.shape[1::-1] for image in images], np.float32)
    shrunk = np.array([image.shape[1::-1] for image in small], np.float32)
    return PicturePair(np.stack(pair).astype(np.float32) / np.float32(255), shrunk / sizes, sizes)
