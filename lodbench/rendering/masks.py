"""Masks: bit-packed, silhouettes of buildings within their boxes, the signed distance to an outline.

Of packed masks 64 pixels make a word, the lowest bit leftmost.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.kernels import count_bits

Words = NDArray[np.uint64]


def words_per_row(width: int) -> int:
    """Returns how many 64-bit words hold a row of ``width`` pixels."""
    return (width + 63) // 64


def pack_mask(mask: NDArray[np.bool_]) -> Words:
    """Returns the (H, ceil(W / 64)) uint64 words of a (H, W) mask; padding bits are 0."""
    height, width = mask.shape
    padded = np.zeros((height, words_per_row(width) * 64), dtype=np.uint8)
    padded[:, :width] = mask
    return np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64, copy=False)


def unpack_mask(words: Words, width: int) -> NDArray[np.bool_]:
    """Returns the (H, W) mask of (H, ceil(W / 64)) words."""
    octets = np.ascontiguousarray(words, dtype="<u8").view(np.uint8)
    return np.unpackbits(octets, axis=1, bitorder="little")[:, :width].astype(np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class Instances:
    """The silhouettes of the buildings of a view, each cut to the rows and 64-pixel words it covers.

    Silhouettes overlap: buildings do not hide each other. Those that cover no pixel are left out.
    """

    size: tuple[int, int]  # width and height of the view, pixels
    buildings: NDArray[np.int64]  # (K,) int64 indices into ``scene.building_ids``, ascending
    boxes: NDArray[np.int64]  # (K, 4) int64: first row, last row + 1, first word, last word + 1
    starts: NDArray[np.int64]  # (K + 1,) int64 offsets into ``words``
    words: Words  # uint64, as of ``pack_mask``, box after box, row by row

    def __len__(self) -> int:
        return len(self.buildings)

    def crop(self, k: int) -> tuple[NDArray[np.bool_], int, int]:
        """Returns the k-th silhouette within its box, and the row and column where that begins."""
        top, bottom, left, right = (int(side) for side in self.boxes[k])
        words = self.words[self.starts[k] : self.starts[k + 1]].reshape(bottom - top, right - left)
        return unpack_mask(words, min(64 * right, self.size[0]) - 64 * left), top, 64 * left

    def mask(self, k: int) -> NDArray[np.bool_]:
        """Returns the (H, W) mask of the k-th silhouette."""
        crop, top, left = self.crop(k)
        mask = np.zeros(self.size[::-1], dtype=np.bool_)
        mask[top : top + crop.shape[0], left : left + crop.shape[1]] = crop
        return mask

    def masks(self) -> Iterator[tuple[int, NDArray[np.bool_]]]:
        """Yields each building's index and (H, W) mask."""
        for k, building in enumerate(self.buildings):
            yield int(building), self.mask(k)

    def areas(self) -> NDArray[np.int64]:
        """Returns (K,) int64 pixels of each silhouette."""
        spans = zip(self.starts[:-1], self.starts[1:], strict=True)
        return np.array([count_bits(self.words[a:b]) for a, b in spans], dtype=np.int64)


def signed_distance(mask: NDArray[np.bool_], is_exact: bool = False) -> NDArray[np.float32]:
    """Returns the distance of pixel centres to a mask's outline, (H, W) float32 pixels, positive inside.

    The outline runs halfway between two pixel centres. A mask with one value everywhere has no outline: all
    its distances are as far as the image is wide and high.

    Args:
        mask: (H, W).
        is_exact: Whether distances are Euclidean; else chamfer distances, 2 % off at most, are fast.
    """
    import cv2

    if mask.all() or not mask.any():
        return np.full(mask.shape, (1.0 if mask.any() else -1.0) * sum(mask.shape), dtype=np.float32)
    size = cv2.DIST_MASK_PRECISE if is_exact else cv2.DIST_MASK_5
    inside, outside = (
        cv2.distanceTransform(side.view(np.uint8), cv2.DIST_L2, size) for side in (mask, ~mask)
    )
    if is_exact:
        # OpenCV's last digit depends on how many threads it has. Squares of distances are whole numbers.
        squares = (np.rint(side.astype(np.float64) ** 2) for side in (inside, outside))
        inside, outside = (np.sqrt(square).astype(np.float32) for square in squares)
    return np.where(mask, inside - np.float32(0.5), np.float32(0.5) - outside)
