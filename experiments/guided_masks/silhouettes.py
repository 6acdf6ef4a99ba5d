"""Silhouettes that are off by a known amount: moved, turned, simplified to blocks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.storage import random_stream

Mask = NDArray[np.bool_]

# Shifts are stated in pixels of a photo this wide, whatever its size.
REFERENCE_PX = 1200.0
# Buildings as blocks: squares of this side along each building's own axes; and how many are gone or added.
_BLOCK_PX, _CHANGED_SHARE = 30.0, 0.1


class Disturbance(NamedTuple):
    """How far a silhouette is off.

    Attributes:
        shift_px: In a random direction, pixels of a photo 1200 wide.
        turn_deg: To either side.
        is_blocks: Whether its buildings are simplified to blocks, a tenth of them gone or another one added.
    """

    shift_px: float
    turn_deg: float
    is_blocks: bool = False

    def __str__(self) -> str:
        return f"{self.shift_px:g} px, {self.turn_deg:g} deg" + (", blocks" if self.is_blocks else "")


def disturbed(truth: Mask, disturbance: Disturbance, draws: int, seed: int, key: str) -> Iterator[Mask]:
    """Yields silhouettes (H, W) of a photo that are off by so much; blocks move as true outlines do.

    Args:
        truth: (H, W) the traced mask.
        disturbance: How far off.
        draws: How many.
        seed: Of the draws.
        key: Of the photo.
    """
    for draw in range(draws):
        generator = random_stream(seed, "guided masks", key, draw)
        away, side = generator.uniform(0.0, 2.0 * math.pi), 1.0 if generator.random() < 0.5 else -1.0
        shift = disturbance.shift_px * max(truth.shape) / REFERENCE_PX
        given = _as_blocks(truth, generator) if disturbance.is_blocks else truth
        motion = (shift * math.cos(away), shift * math.sin(away), side * disturbance.turn_deg)
        yield _moved(given, *motion)


def _as_blocks(mask: Mask, generator: np.random.Generator) -> Mask:
    """Returns each building as squares along its own axes; a twentieth gone, a twentieth there once more."""
    side = _BLOCK_PX * max(mask.shape) / REFERENCE_PX
    height, width = mask.shape
    blocks = np.zeros_like(mask)
    count, labels = cv2.connectedComponents(mask.astype(np.uint8))
    for label in range(1, count):
        building = labels == label
        chance = generator.random()
        if chance < 0.5 * _CHANGED_SHARE:
            continue
        rough = _rough(building, side)
        blocks |= rough
        if chance > 1.0 - 0.5 * _CHANGED_SHARE:
            right, down = generator.uniform(-0.5, 0.5, 2) * (width, height)
            blocks |= _moved(rough, right, down, generator.uniform(-90.0, 90.0))
    return blocks


def _rough(building: Mask, side: float) -> Mask:
    """Returns the squares of a grid along a building's axes that it fills by half or more."""
    height, width = building.shape
    points = np.argwhere(building)[:, ::-1].astype(np.float32)
    matrix = cv2.getRotationMatrix2D((0.5 * width, 0.5 * height), cv2.minAreaRect(points)[2], 1.0 / side)
    cells = math.ceil(math.hypot(height, width) / side) + 4
    matrix = matrix + np.array([[0.0, 0.0, 0.5 * (cells - width)], [0.0, 0.0, 0.5 * (cells - height)]])
    shares = cv2.GaussianBlur(
        building.astype(np.float32), (0, 0), 0.35 * side, borderType=cv2.BORDER_REPLICATE
    )
    grid = cv2.warpAffine(shares, matrix, (cells, cells), borderMode=cv2.BORDER_REPLICATE) >= 0.5
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(grid.astype(np.uint8), matrix, (width, height), flags=flags) > 0)


def _moved(mask: Mask, right: float, down: float, turn_deg: float) -> Mask:
    height, width = mask.shape
    matrix = cv2.getRotationMatrix2D((0.5 * (width - 1), 0.5 * (height - 1)), turn_deg, 1.0)
    matrix = matrix + np.array([[0.0, 0.0, right], [0.0, 0.0, down]])
    return np.asarray(cv2.warpAffine(mask.astype(np.uint8) * 255, matrix, (width, height)) >= 128)
