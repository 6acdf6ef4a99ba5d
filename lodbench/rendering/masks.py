"""Bit-packed masks, 64 pixels to a word, lowest bit leftmost; silhouettes of buildings within their boxes."""

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
