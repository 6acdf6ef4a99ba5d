"""A clean building mask made as wrong as a segmentation network's: one generator for every use.

Every kind of error is drawn once, as a field that says at which strength each pixel turns wrong
(``mask_error_fields``). Strength 1 is an outline that wobbles by about 0.4 m.
One number, the strength, then turns the whole mask from clean to hopeless, and bisection finds the
strength that meets a target IoU without drawing a random number twice.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lodbench.errors import LodbenchError
from lodbench.storage import random_stream
from lodbench.synthesis.mask_error_fields import (
    Field,
    Mask,
    added_blobs,
    dropped_areas,
    moved_outline,
    signed_distance,
    trees_in_front,
)

# How close the achieved IoU comes to the target, unless one pixel is already more than that.
IOU_TOLERANCE = 0.005
# Halvings of the bracket around the strength: down to a millionth, finer than any tie of pixels.
_BISECTIONS = 20
# Pixels per metre of a 602-pixel-wide view from about 160 m, the benchmark's usual distance.
_TYPICAL_PIXELS_PER_M = 2.6


def degrade_mask(
    mask: Mask,
    target_iou: float,
    generator: np.random.Generator,
    *,
    trees: bool = True,
    pixels_per_m: float | None = None,
    truth: Mask | None = None,
) -> tuple[Mask, float]:
    """Returns a mask with the errors of a segmentation network, at an IoU with the clean one.

    The errors are connected, never independent per pixel: an outline that wobbles and rounds its
    corners, trees in front of buildings, roofs and small buildings missed, and patches added.

    Args:
        mask: (H, W) bool, True on buildings.
        target_iou: Wanted IoU with ``mask``, in (0, 1]; 1 returns a copy of the mask.
        generator: The only source of randomness.
        trees: Whether trees stand in front of buildings.
        pixels_per_m: Image scale at the buildings, for the size of trees and patches; by default
            that of the benchmark's drone views (2.6 pixels per metre in an image 602 wide).
        truth: (H, W) bool, the mask to measure the IoU with, where it is not ``mask``: with trees that
            hide buildings already taken out of ``mask``. Where they alone take more than the target
            allows, ``mask`` comes back as it is.

    Returns:
        The degraded mask, (H, W) bool, and the IoU achieved: within `IOU_TOLERANCE` of the target,
        or as near as single pixels allow in a mask of a few hundred pixels. An empty mask comes
        back empty with IoU 0, for it has no buildings to be wrong about.

    Raises:
        LodbenchError: The mask is not a bool image, the target lies outside (0, 1], or the scale is
            not positive.
    """
    if mask.ndim != 2 or mask.dtype != np.bool_:
        raise LodbenchError(f"A mask is a bool image (H, W), not {mask.dtype} of shape {mask.shape}.")
    if not 0.0 < target_iou <= 1.0:
        raise LodbenchError(f"A target IoU lies in (0, 1], not {target_iou}.")
    if pixels_per_m is not None and not pixels_per_m > 0.0:
        raise LodbenchError(f"An image scale is positive, not {pixels_per_m} pixels per metre.")
    truth = mask if truth is None else truth
    if not mask.any():
        return mask.copy(), 0.0
    if mask_iou(mask, truth) <= target_iou:
        return mask.copy(), mask_iou(mask, truth)
    errors = _draw_errors(mask, generator, trees, pixels_per_m or typical_pixels_per_m(mask.shape))
    wrong = errors.apply(mask, _strength_for(errors, mask, truth, target_iou))
    return wrong, mask_iou(wrong, truth)


def mask_iou(a: Mask, b: Mask) -> float:
    """Returns intersection over union of two (H, W) masks; 0 when both are empty."""
    union = int(np.count_nonzero(a | b))
    return int(np.count_nonzero(a & b)) / union if union else 0.0


def typical_pixels_per_m(shape: tuple[int, ...]) -> float:
    """Returns the image scale of the benchmark's drone views at a size, (height, width) pixels."""
    height, width = shape
    return _TYPICAL_PIXELS_PER_M * math.sqrt(height * width / (602 * 448))


class _Errors(NamedTuple):
    """The fields of errors in the order they act in.

    First the outline moves, then buildings are missed or hidden together with what their outline gained,
    then ground is added.
    """

    outline: Field
    hidden: Field
    added: Field

    def apply(self, mask: Mask, strength: float) -> Mask:
        """Returns the mask, (H, W), with the errors of a strength."""
        moved = (mask ^ (self.outline < strength)) & (self.hidden >= strength)
        return np.asarray(moved | (~mask & (self.added < strength)))


def _draw_errors(mask: Mask, generator: np.random.Generator, trees: bool, pixels_per_m: float) -> _Errors:
    """Draws every field once; each has a stream of its own, so leaving trees out changes no other."""
    seed = int(generator.integers(2**63))
    streams = [random_stream(seed, kind) for kind in ("outline", "dropped", "trees", "added")]
    distance, labels = signed_distance(mask)
    outline = moved_outline(distance, streams[0], pixels_per_m)
    hidden = dropped_areas(mask, labels, streams[1], pixels_per_m)
    if trees:
        np.minimum(hidden, trees_in_front(mask, streams[2], pixels_per_m), out=hidden)
    return _Errors(outline, hidden, added_blobs(mask, streams[3], pixels_per_m))


def _strength_for(errors: _Errors, mask: Mask, truth: Mask, target: float) -> float:
    """Returns the strength whose errors bring the IoU with the truth nearest to the target."""
    # Pixels outside the mask never leave it, and the other way about: each field is needed in one place.
    lost_at = np.minimum(errors.outline, errors.hidden)
    held, surplus = lost_at[mask & truth], lost_at[mask & ~truth]
    missed, free = (_Errors(*(field[area] for field in errors)) for area in (truth & ~mask, ~truth & ~mask))
    num_true = int(np.count_nonzero(truth))

    def gained(area: _Errors, strength: float) -> int:
        return int(np.count_nonzero(area.apply(np.zeros(len(area.added), bool), strength)))

    def iou(strength: float) -> float:
        shared = int(np.count_nonzero(held >= strength)) + gained(missed, strength)
        beyond = int(np.count_nonzero(surplus >= strength)) + gained(free, strength)
        return shared / (num_true + beyond)

    # Every building pixel is missed at some strength, so doubling gets below any target.
    low, high = 0.0, 1.0
    while iou(high) > target:
        low, high = high, 2 * high
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if iou(middle) > target else (low, middle)
    return min((low, high), key=lambda strength: abs(iou(strength) - target))
