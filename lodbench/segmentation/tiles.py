"""A photo in overlapping tiles, where it does not fit into memory whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

Photo = NDArray[np.uint8]
Floats = NDArray[np.float32]
# Tiles reach so far into each other, pixels: what a network sees beyond its own border.
_OVERLAP = 64


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
