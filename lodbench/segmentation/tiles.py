"""A photo in overlapping tiles, where it does not fit into memory whole."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import QueryFault

Photo = NDArray[np.uint8]
Floats = NDArray[np.float32]
# Tiles reach so far into each other, pixels: what a network sees beyond its own border.
_OVERLAP = 64
_MOST_PARTS = 8
_OUT_OF_MEMORY = ("out of memory", "not enough memory", "insufficient memory", "failed to allocate")


class MemoryTiles:
    """Runs a network on whole photos; from the first that does not fit into memory on, in tiles.

    Args:
        name: Of the segmenter, for messages.
        size: Of its photos, for messages.
        stride: Sides of tiles are multiples of this.
        can_tile: Whether the network answers to smaller pictures as well.
    """

    def __init__(self, name: str, size: int, stride: int, can_tile: bool = True) -> None:
        self._name, self._size, self._stride, self._can_tile = name, size, stride, can_tile
        self._parts = 1

    def run(self, photo: Photo, run: Callable[[Photo], Floats]) -> Floats:
        """Returns the (H, W) answer of ``run`` to a photo, or that joined from its answers to tiles.

        Raises:
            QueryFault: The photo does not fit into memory, not even in tiles.
        """
        while True:
            try:
                return tiled(photo, self._parts, self._stride, run)
            except Exception as error:
                if not is_out_of_memory(error):
                    raise
            if self._parts >= _MOST_PARTS or not self._can_tile:
                raise QueryFault(f"{self._name} runs out of memory at size {self._size}")
            self._parts *= 2
            sys.stderr.write(
                f"lodbench: {self._name}: out of memory; going on in {self._parts} x {self._parts} tiles.\n"
            )


def is_out_of_memory(error: BaseException) -> bool:
    """Returns whether an error says that memory ran out, on whatever device, in whatever library."""
    told = str(error).lower()
    return isinstance(error, MemoryError) or any(words in told for words in _OUT_OF_MEMORY)


def tiled(photo: Photo, parts: int, stride: int, run: Callable[[Photo], Floats]) -> Floats:
    """Returns (H, W) answers joined from ``parts`` x ``parts`` tiles, faded into each other.

    Args:
        photo: (H, W, 3), sides multiples of ``stride``.
        parts: Tiles along each side.
        stride: Sides of tiles are multiples of this.
        run: Returns the (h, w) answer to a tile.
    """
    total, weights = np.zeros(photo.shape[:2], np.float64), np.zeros(photo.shape[:2], np.float64)
    for rows in _spans(photo.shape[0], parts, stride):
        for columns in _spans(photo.shape[1], parts, stride):
            fade = np.minimum.outer(_fade(rows), _fade(columns))
            total[rows, columns] += fade * run(np.ascontiguousarray(photo[rows, columns]))
            weights[rows, columns] += fade
    return (total / weights).astype(np.float32)


def _spans(length: int, parts: int, stride: int) -> Iterator[slice]:
    side = -(-length // (parts * stride)) * stride
    side = min(length, side + -(-_OVERLAP // stride) * stride)
    for start in np.linspace(0, length - side, parts if side < length else 1):
        first = round(start / stride) * stride
        yield slice(first, first + side)


def _fade(span: slice) -> NDArray[np.float64]:
    """Returns weights that rise from a tile's border to its inside; never zero."""
    inside = np.arange(span.stop - span.start) + 1.0
    return np.minimum(np.minimum(inside, inside[::-1]), _OVERLAP / 2)
