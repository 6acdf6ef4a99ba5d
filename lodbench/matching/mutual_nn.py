"""``mutual_nn``, ``sift_nn``: two features match where each is the other's nearest, and clearly so."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
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
        to_second, distance = self._nearest(first.descriptors, second.descriptors)
        to_first, _ = self._nearest(second.descriptors, first.descriptors)
        here = np.flatnonzero(to_second >= 0)
        here = here[to_first[to_second[here]] == here]
        return Matches(first.keypoints[here], second.keypoints[to_second[here]], -distance[here])

    def _nearest(
        self, these: NDArray[np.float32], those: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Returns for each of these the number of the nearest of those and its distance; -1 for none."""
        index = np.full(len(these), -1, dtype=np.int64)
        distance = np.full(len(these), np.inf, dtype=np.float32)
        if len(these) == 0 or len(those) == 0:
            return index, distance
        for number, found in enumerate(cv2.BFMatcher(cv2.NORM_L2).knnMatch(these, those, k=2)):
            if len(found) == 1 or found[0].distance <= self.params.ratio * found[1].distance:
                index[number], distance[number] = found[0].trainIdx, found[0].distance
        return index, distance


class SiftNn(MutualNn):
    """Mutual nearest neighbours of SIFT's features: the classical matcher."""

    extractor = "sift"
