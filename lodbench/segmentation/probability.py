"""From a network's logits to the probability that is thresholded (paper, section 3.2)."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any, Literal, TypeVar

import cv2
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


Photo = NDArray[np.uint8]
Floats = NDArray[np.float32]
Number = TypeVar("Number", bound=np.integer[Any] | np.floating[Any])
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
    stated = str(error).lower()
    return isinstance(error, MemoryError) or any(words in stated for words in _OUT_OF_MEMORY)


def tiled(photo: Photo, parts: int, stride: int, run: Callable[[Photo], Floats]) -> Floats:
    """Returns (H, W), or (H, W, channels), answers joined from ``parts`` x ``parts`` tiles, faded together.

    Args:
        photo: (H, W, 3), sides multiples of ``stride``.
        parts: Tiles along each side.
        stride: Sides of tiles are multiples of this.
        run: Returns the (h, w), or (h, w, channels), answer to a tile.
    """
    total, weights = np.zeros(0), np.zeros(photo.shape[:2], np.float64)
    for rows in _spans(photo.shape[0], parts, stride):
        for columns in _spans(photo.shape[1], parts, stride):
            fade = np.minimum.outer(_fade(rows), _fade(columns))
            answer = run(np.ascontiguousarray(photo[rows, columns]))
            if not total.size:
                total = np.zeros((*photo.shape[:2], *answer.shape[2:]), np.float64)
            # Transposed, a weight per pixel is one for all of its channels.
            total[rows, columns] += (fade.T * answer.T).T
            weights[rows, columns] += fade
    return (total.T / weights.T).T.astype(np.float32)


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


def working_size(width: int, height: int, longest: int) -> tuple[int, int]:
    """Returns the width and height of a photo whose long side is ``longest``; never below one pixel."""
    factor = longest / max(width, height)
    return max(1, round(width * factor)), max(1, round(height * factor))


def resized_photo(photo: NDArray[Number], width: int, height: int) -> NDArray[Number]:
    """Returns (H, W, ...) at another size: averaged where it shrinks, interpolated where it grows."""
    if photo.shape[:2] == (height, width):
        return photo
    shrinks = width * height < photo.shape[0] * photo.shape[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(photo, (width, height), interpolation=how), photo.dtype)


def padded_photo(
    photo: NDArray[np.uint8], stride: int, mode: Literal["edge", "symmetric"] = "edge"
) -> NDArray[np.uint8]:
    """Returns a photo with its last row and column repeated, or mirrored, up to multiples of a stride."""
    height, width = photo.shape[:2]
    return np.pad(photo, ((0, -height % stride), (0, -width % stride), (0, 0)), mode=mode)
