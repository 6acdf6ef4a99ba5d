"""Instance masks from the two outputs of a YOLOv8 segmentation network (FastSAM's kind)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
# Never more instances of a photo than this, the likeliest first.
_MOST = 300
# Prototypes are a quarter as long and as wide as the input.
STRIDE = 4


@dataclass(frozen=True, slots=True, eq=False)
class Instances:
    """What a network found in a photo, likeliest first.

    Attributes:
        masks: (N, H, W) bool, at the size of the network's input.
        scores: (N,) in [0, 1].
        classes: (N,) numbers of their classes.
    """

    masks: NDArray[np.bool_]
    scores: Floats
    classes: NDArray[np.int64]


def decode(rows: Floats, prototypes: Floats, least_score: float, most_overlap: float) -> Instances:
    """Returns the instances behind a network's outputs for one photo.

    A row is an anchor: the centre, width and height of its box in input pixels, a score per class,
    and what its mask takes of each prototype. Of boxes of one class that overlap the likeliest stays.

    Args:
        rows: (4 + classes + P, anchors).
        prototypes: (P, H / 4, W / 4), logits.
        least_score: Anchors less likely than this are nothing.
        most_overlap: IoU of boxes from which on the less likely goes.
    """
    num_classes = len(rows) - 4 - len(prototypes)
    scores, classes = rows[4 : 4 + num_classes].max(axis=0), rows[4 : 4 + num_classes].argmax(axis=0)
    likely = np.flatnonzero(scores >= least_score)
    likely = likely[np.argsort(-scores[likely], kind="stable")]
    corners = _corners(rows[:4, likely])
    kept = likely_apart(corners, scores[likely], classes[likely], most_overlap)
    chosen, corners = likely[kept], corners[kept]
    coefficients = rows[4 + num_classes :, chosen].T
    return Instances(_masks(coefficients, prototypes, corners), scores[chosen], classes[chosen])


def likely_apart(
    corners: Floats, scores: Floats, classes: NDArray[np.int64], most_overlap: float
) -> NDArray[np.int64]:
    """Returns which of (N, 4) boxes stay, at most 300: non-maximum suppression within each class."""
    import cv2

    if not len(scores):
        return np.zeros(0, np.int64)
    boxes = np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=1)
    kept: Any = cv2.dnn.NMSBoxesBatched(
        boxes.tolist(), scores.tolist(), classes.tolist(), 0.0, most_overlap, top_k=0
    )
    return np.sort(np.asarray(kept, np.int64).ravel())[:_MOST]


def counted(
    found: Instances, classes: list[int], most_share: float, shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Returns the (N, H, W) masks of the instances that count.

    Args:
        found: All instances.
        classes: Numbers of the classes that count; empty for all.
        most_share: Instances that cover more of the photo do not count: ground, sky, a whole quarter.
        shape: Height and width, where nothing was found.
    """
    if not len(found.masks):
        return np.zeros((0, *shape), np.bool_)
    counts = found.masks.mean(axis=(1, 2)) <= most_share
    if classes:
        counts &= np.isin(found.classes, classes)
    return np.asarray(found.masks[counts])


def _corners(boxes: Floats) -> Floats:
    """Returns (N, 4) left, top, right, bottom of (4, N) centres and sizes."""
    centre, half = boxes[:2].T, boxes[2:].T / 2
    return np.asarray(np.concatenate([centre - half, centre + half], axis=1), np.float32)


def _masks(coefficients: Floats, prototypes: Floats, corners: Floats) -> NDArray[np.bool_]:
    """Returns (N, H, W): positive logits at the size of the input, inside each one's box."""
    import cv2

    count, height, width = prototypes.shape
    size = (width * STRIDE, height * STRIDE)
    logits = (coefficients @ prototypes.reshape(count, -1)).reshape(-1, height, width)
    masks = np.zeros((len(coefficients), size[1], size[0]), np.bool_)
    for mask, small, (left, top, right, bottom) in zip(
        masks, logits, corners.round().astype(int), strict=True
    ):
        rows, columns = slice(max(0, top), max(0, bottom)), slice(max(0, left), max(0, right))
        large = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)
        mask[rows, columns] = large[rows, columns] > 0
    return masks
