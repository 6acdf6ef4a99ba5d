"""``mutual_nn``, ``sift_nn``: two features match where each is the other's nearest, and clearly so."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import require_within
from lodbench.matching.protocol import FEATURES, Features, Matches

# So many descriptors are compared with all others at once: memory does not grow with their square.
_ROWS = 1024


@dataclass(frozen=True, slots=True)
class MutualNnParams:
    """Settings of mutual nearest neighbours.

    Attributes:
        ratio: The nearest is closer than the second by this factor at least, both ways (Lowe's test);
            1 for any.
    """

    ratio: float = 0.9

    def __post_init__(self) -> None:
        require_within("ratio", self.ratio, 0, 1, "(]")


class MutualNn:
    """Compares all descriptors of two pictures by their Euclidean distance."""

    params_type = MutualNnParams
    takes = FEATURES

    def __init__(self, params: MutualNnParams) -> None:
        self.params = params

    def match(self, first: Features, second: Features) -> Matches:
        """Returns the matches, in the first picture's order; the score is minus the distance."""
        if len(first.descriptors) == 0 or len(second.descriptors) == 0:
            return Matches(first.keypoints[:0], second.keypoints[:0], np.zeros(0, np.float32))
        to_second, distance = self._nearest(first.descriptors, second.descriptors)
        to_first, _ = self._nearest(second.descriptors, first.descriptors)
        here = np.flatnonzero(to_second >= 0)
        here = here[to_first[to_second[here]] == here]
        return Matches(first.keypoints[here], second.keypoints[to_second[here]], -distance[here])

    def _nearest(
        self, these: NDArray[np.float32], those: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Returns for each of these the number of the nearest of those, -1 for none, and its distance."""
        index = np.full(len(these), -1, dtype=np.int64)
        distance = np.full(len(these), np.inf, dtype=np.float32)
        lengths = (those**2).sum(axis=1)
        for first in range(0, len(these), _ROWS):
            some = these[first : first + _ROWS]
            # Squared distances, but for what all of a row have in common.
            away = lengths - 2.0 * (some @ those.T)
            rows = np.arange(len(some))
            nearest = away.argmin(axis=1)
            away[rows, nearest] = np.inf
            second = away.argmin(axis=1)
            # Differences of large squares round: the two that count are measured again.
            one, two = (np.linalg.norm(some - those[found], axis=1) for found in (nearest, second))
            nearest, one, two = (
                np.where(two < one, second, nearest),
                np.minimum(one, two),
                np.maximum(one, two),
            )
            is_clear = (one <= self.params.ratio * two) | (len(those) == 1)
            index[first : first + _ROWS] = np.where(is_clear, nearest, -1)
            distance[first : first + _ROWS] = one
        return index, distance


class SiftNn(MutualNn):
    """Mutual nearest neighbours of SIFT's features: the classical matcher."""

    extractor = "sift"
