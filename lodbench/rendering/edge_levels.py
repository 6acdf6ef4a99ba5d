"""How strongly a photo changes along every direction at every pixel."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from lodbench.rendering.mean_around import mean_around

Levels = NDArray[np.uint8]

# Levels of strength, equally full over all pixels and directions, and directions over half a turn.
EDGE_LEVELS, DIRECTIONS = 16, 12
# The part of the width that the mean strength is taken over.
_AROUND_SHARE = 12.0
# Every so many-th row and column says where one level ends and the next begins.
_STEP = 3
# Steps of strength per mean strength, and how many are told apart.
_FINE_STEPS, _FINEST = 256.0, 4095


def directed_edge_levels(photo: NDArray[Any], size: tuple[int, int], blur_px: float) -> Levels:
    """Returns (H, W, 12) uint8 how strongly brightness and colour change along each direction, 0 to 15.

    Gradients of L, a and b (CIE Lab) are taken after a blur and divided by their mean around the pixel, so
    that a sharp foreground does not outweigh what lies in haze. Direction ``k`` is ``k * pi / 12`` from the
    picture's x axis towards its y axis.

    Args:
        photo: (H, W) or (H, W, 3) BGR, 8 bits.
        size: Width and height to work at, pixels.
        blur_px: Standard deviation of the blur, pixels of that size.
    """
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    if small.ndim == 2:
        small = np.repeat(small[..., None], 3, axis=2)
    lab = cv2.GaussianBlur(cv2.cvtColor(small / np.float32(255), cv2.COLOR_BGR2LAB), (0, 0), blur_px)
    across, down = (cv2.Sobel(lab, cv2.CV_32F, *axis, scale=0.125) for axis in ((1, 0), (0, 1)))
    # The strength along a direction is a quadratic form of it: three sums over the channels say all.
    xx, xy, yy = (_over_channels(*pair) for pair in ((across, across), (across, down), (down, down)))
    around = mean_around(np.sqrt(xx + yy), size[0] / _AROUND_SHARE) + np.float32(1e-3)
    angles = np.arange(DIRECTIONS) * (np.pi / DIRECTIONS)
    turns = np.stack(
        [np.cos(angles) ** 2, 2.0 * np.cos(angles) * np.sin(angles), np.sin(angles) ** 2], axis=1
    )
    forms = np.ascontiguousarray(np.stack([xx, xy, yy], axis=2) / (around**2)[..., None])
    some = np.sqrt(np.maximum(forms[::_STEP, ::_STEP] @ turns.T, 0.0)) * _FINE_STEPS
    levels: Levels = _looked_up(forms, turns, _level_table(np.minimum(some, _FINEST).astype(np.int64)))
    return levels


def _over_channels(one: NDArray[Any], other: NDArray[Any]) -> NDArray[np.float32]:
    """Returns the (H, W) sums of products over three channels; numpy's own over so short an axis are slow."""
    product = one * other
    return np.asarray(product[..., 0] + product[..., 1] + product[..., 2])


def _level_table(steps: NDArray[np.int64]) -> Levels:
    """Returns (4096,) the level of each fine step of strength, so that levels are equally full.

    A search for the level of each strength would take longer than all else.

    Args:
        steps: Some of a photo, in fine steps.
    """
    up_to = np.bincount(steps.ravel(), minlength=_FINEST + 1).cumsum()
    places = np.arange(1, EDGE_LEVELS) / EDGE_LEVELS * (steps.size - 1)
    low, high = (np.searchsorted(up_to, whole(places), side="right") for whole in (np.floor, np.ceil))
    ends = low + (high - low) * (places - np.floor(places))
    return np.searchsorted(ends, np.arange(_FINEST + 1), side="right").astype(np.uint8)


@njit(cache=True, nogil=True, error_model="numpy")
def _looked_up(forms, turns, table):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns (H, W, 12) uint8 levels of quadratic forms (H, W, 3) of directions (12, 3)."""
    height, width = forms.shape[:2]
    levels = np.empty((height, width, len(turns)), dtype=np.uint8)
    for row in range(height):
        for column in range(width):
            form = forms[row, column]
            for k in range(len(turns)):
                square = form[0] * turns[k, 0] + form[1] * turns[k, 1] + form[2] * turns[k, 2]
                step = np.sqrt(max(square, 0.0)) * _FINE_STEPS
                levels[row, column, k] = table[int(min(step, _FINEST))]
    return levels
