"""What a whole flight is wrong about, found by vote: each photo's own answer is tried on all the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.geometry.pose_vector import pose_from_vector
from lodbench.methods.flight.params import Params
from lodbench.segmentation import binary_mask

Floats = NDArray[np.float64]

# Masks are compared at this width, pixels.
_WIDTH = 150


def flight_error(
    queries: Sequence[Query], priors: Floats, offsets: Floats, city_map: CityMap, params: Params
) -> tuple[Floats, float]:
    """Returns (6,) what the sensors of a flight are wrong about alike, and the mean IoU with it.

    Eq. (F14) of docs/methods/flight.md.

    Args:
        queries: The photos.
        priors: (P, 6) what the sensors said, metres and degrees.
        offsets: (N, 6) candidates: poses that photos found by themselves, less what was said of them.
        city_map: Draws silhouettes.
        params: How many candidates, and judges.
    """
    judges = _spread(len(queries), params.votes)
    tried = np.concatenate([np.zeros((1, 6)), offsets[_spread(len(offsets), params.votes)]])
    ious = np.array([_mean_iou(offset, queries, priors, judges, city_map) for offset in tried])
    best = tried[int(np.argmax(ious))]
    # Photos that agree with the best: their mean is surer than each.
    width = 3.0 * params.own_sigmas() + 0.25 * params.shared_sigmas()
    agreeing = offsets[(np.abs(offsets - best) < width).all(axis=1)]
    if len(agreeing) > 2:
        middle = np.median(agreeing, axis=0)
        iou = _mean_iou(middle, queries, priors, judges, city_map)
        if iou > ious.max():
            return middle, iou
    return best, float(ious.max())


def _mean_iou(
    offset: Floats, queries: Sequence[Query], priors: Floats, judges: NDArray[np.int64], city_map: CityMap
) -> float:
    total = 0.0
    for k in judges:
        camera = queries[k].camera
        small = camera.scaled(_WIDTH, max(1, round(_WIDTH * camera.height / camera.width)))
        mask = binary_mask(queries[k].mask, small.width, small.height)
        shown = city_map.render(small, pose_from_vector(priors[k] + offset))
        union = np.count_nonzero(shown | mask)
        total += np.count_nonzero(shown & mask) / union if union else 0.0
    return total / len(judges)


def _spread(count: int, most: int) -> NDArray[np.int64]:
    """Returns at most so many indices, spread evenly."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.int64))
