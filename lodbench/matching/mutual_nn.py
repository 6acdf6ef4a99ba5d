"""``mutual_nn``, ``sift_nn``: two features match where each is the other's nearest, and clearly so."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import require_within
from lodbench.matching.protocol import FEATURES, Features, Matches


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
        squares = _squared_distances(first.descriptors, second.descriptors)
        to_second, distance = self._nearest(squares)
        to_first, _ = self._nearest(np.ascontiguousarray(squares.T))
        here = np.flatnonzero(to_second >= 0)
        here = here[to_first[to_second[here]] == here]
        return Matches(first.keypoints[here], second.keypoints[to_second[here]], -distance[here])

    def _nearest(self, squares: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Returns for each row of (N, M) squared distances the nearest column, -1 for none; how far it is."""
        index = squares.argmin(axis=1)
        rows = np.arange(len(squares))
        nearest = squares[rows, index]
        squares[rows, index] = np.inf
        second = squares.min(axis=1)
        squares[rows, index] = nearest
        is_clear = np.sqrt(nearest) <= self.params.ratio * np.sqrt(second)
        return np.where(is_clear, index, -1), np.sqrt(nearest)


def _squared_distances(these: NDArray[np.float32], those: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns (N, M) squared Euclidean distances of (N, D) and (M, D) descriptors."""
    lengths = (these**2).sum(axis=1)[:, None] + (those**2).sum(axis=1)
    return np.asarray(np.maximum(lengths - 2.0 * (these @ those.T), 0.0))


class SiftNn(MutualNn):
    """Mutual nearest neighbours of SIFT's features: the classical matcher."""

    extractor = "sift"
