"""Panoptic quality of single buildings (Kirillov et al., Panoptic Segmentation, CVPR 2019)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class InstanceMatches:
    """How buildings that were found go with those that are there; sums over photos are `+`."""

    matched: int = 0
    iou_sum: float = 0.0
    found: int = 0
    true: int = 0

    def __add__(self, other: InstanceMatches) -> InstanceMatches:
        return InstanceMatches(
            self.matched + other.matched,
            self.iou_sum + other.iou_sum,
            self.found + other.found,
            self.true + other.true,
        )

    @property
    def recognition(self) -> float:
        """Returns the share of pairs among all, RQ, which is the F1 at IoU one half; NaN of nothing."""
        either = self.found + self.true
        return 2 * self.matched / either if either else float("nan")

    @property
    def segmentation(self) -> float:
        """Returns the mean IoU of pairs, SQ; NaN where there is none."""
        return self.iou_sum / self.matched if self.matched else float("nan")

    @property
    def panoptic(self) -> float:
        """Returns PQ, the product of both; NaN of nothing."""
        return 2 * self.iou_sum / (self.found + self.true) if self.found + self.true else float("nan")


def match_instances(found: NDArray[np.integer], true: NDArray[np.integer], least_px: int) -> InstanceMatches:
    """Returns how labels of a photo go with the true ones.

    Args:
        found: (H, W), 0 for no building.
        true: (H, W), likewise.
        least_px: Buildings of fewer pixels do not count, on either side.
    """
    found_ids, a, of_found = np.unique(found, return_inverse=True, return_counts=True)
    true_ids, b, of_true = np.unique(true, return_inverse=True, return_counts=True)
    shared = np.zeros((len(found_ids), len(true_ids)))
    np.add.at(shared, (a.ravel(), b.ravel()), 1)
    counted_found = (found_ids > 0) & (of_found >= least_px)
    counted_true = (true_ids > 0) & (of_true >= least_px)
    iou = shared / (of_found[:, None] + of_true[None] - shared)
    pairs = iou[counted_found][:, counted_true]
    is_pair = pairs > 0.5
    return InstanceMatches(
        int(is_pair.sum()), float(pairs[is_pair].sum()), int(counted_found.sum()), int(counted_true.sum())
    )
