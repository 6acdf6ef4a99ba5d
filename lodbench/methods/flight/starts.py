"""Starts of the joint problem: what the whole flight is off by, by vote, and other starts.

Where a flight ends when it starts elsewhere: what a linearisation at one end cannot tell. Where map and
masks differ by metres, many assignments of the mask's outline to the model's fit alike, and each start ends
at one of its own: orbits round PLATEAU 53392642 end up to 3 m apart at the same overlap, each sure of
itself to half a metre. Over a map that is right all starts end at one place. How far ends lie apart is an
error that all photos share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.estimation.state_vector import differences
from lodbench.geometry.pose import pose_from_vector
from lodbench.methods.flight.params import FlightParams
from lodbench.segmentation import binary_mask

Floats = NDArray[np.float64]

# Masks are compared at this width, pixels.
_WIDTH = 150


def flight_error(
    queries: Sequence[Query], priors: Floats, offsets: Floats, city_map: CityMap, params: FlightParams
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
        small = camera.scaled_to_width(_WIDTH)
        mask = binary_mask(queries[k].mask, small.width, small.height)
        shown = city_map.render(small, pose_from_vector(priors[k] + offset))
        union = np.count_nonzero(shown | mask)
        total += np.count_nonzero(shown & mask) / union if union else 0.0
    return total / len(judges)


def _spread(count: int, most: int) -> NDArray[np.int64]:
    """Returns at most so many indices, spread evenly."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.int64))


Rows = NDArray[np.int64]

# Other starts, metres from where the first one ended: corners of a tetrahedron, so that all ways count alike.
STARTS_M = 1.7 * np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
# Ends whose silhouettes overlap the masks less than the best's by more than this are no answers.
_WORSE_IOU = 0.02
# Photos that start again.
_MOST_PHOTOS = 40


def restarted(count: int, tied: bool) -> Rows:
    """Returns the numbers of the photos of a flight that start again, ascending.

    Of a longer flight some from all over it, since those of one stretch may all look one way; but those in
    its middle where neighbours are tied to each other, since photos far apart are not.
    """
    used = min(count, _MOST_PHOTOS)
    if tied:
        return np.arange(used) + (count - used) // 2
    return np.linspace(0, count - 1, used).round().astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Ends:
    """Where starts end, against where the first does.

    Attributes:
        shifts: (N, 6) by how much photos end elsewhere in the mean, metres and degrees; the first is none.
        constants: (N, 13) what photos share there, see ``joint``.
    """

    shifts: Floats
    constants: Floats

    @property
    def middle(self) -> tuple[Floats, Floats]:
        """Returns the mean shift, (6,), and by how much the constants' mean differs from the first's."""
        return self.shifts.mean(axis=0), self.constants.mean(axis=0) - self.constants[0]

    @property
    def covariances(self) -> tuple[Floats, Floats]:
        """Returns the covariance of an end, (6, 6), and of the constants, (13, 13); zero for one end."""
        if len(self.shifts) == 1:
            return np.zeros((6, 6)), np.zeros((self.constants.shape[1],) * 2)
        return np.cov(self.shifts, rowvar=False), np.cov(self.constants, rowvar=False)


def ends_of(found: Sequence[tuple[Floats, Floats, float]]) -> Ends:
    """Returns where starts end, but for those that fit worse. Eq. (F16) of docs/methods/flight.md.

    Args:
        found: Of each end (P, 6) poses of the same photos, (13,) what they share, and the mean IoU; the first
            is the one that the others are compared with.
    """
    best = max(iou for _, _, iou in found)
    kept = [found[0], *(end for end in found[1:] if end[2] > best - _WORSE_IOU)]
    shifts = [np.median(differences(vectors, found[0][0]), axis=0) for vectors, _, _ in kept]
    return Ends(np.array(shifts), np.array([constants for _, constants, _ in kept]))
