"""Where a flight ends when it starts elsewhere: what a linearisation at one end cannot tell.

Where map and masks differ by metres, many assignments of the mask's outline to the model's fit alike, and
each start ends at one of its own: orbits round PLATEAU 53392642 end up to 3 m apart at the same overlap, each
sure of itself to half a metre. Over a map that is right all starts end at one place. How far ends lie apart
is an error that all photos share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.methods.flight.state import differences

Floats = NDArray[np.float64]
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
