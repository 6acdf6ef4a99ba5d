"""``sift``, ``mutual_nn``, ``sift_nn``: Lowe's features; two match where each is the other's nearest."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import require_numbers, require_within
from lodbench.matching.protocol import FEATURES, Features, Image, Matches, check_image


@dataclass(frozen=True, slots=True)
class SiftParams:
    """Settings of SIFT; the defaults are Lowe's.

    Attributes:
        max_features: At most this many, the strongest; 0 for all.
        contrast_threshold: Weaker extrema do not count.
        edge_threshold: Ratio of curvatures from which on an extremum is an edge's and does not count.
    """

    max_features: int = 4096
    contrast_threshold: float = 0.04
    edge_threshold: float = 10.0

    def __post_init__(self) -> None:
        require_numbers(self, "", ("max_features", "contrast_threshold"), 0)
        require_within("edge_threshold", self.edge_threshold, 1, ends="(]")


class Sift:
    """Finds extrema of differences of Gaussians, and describes their gradients."""

    params_type = SiftParams

    def __init__(self, params: SiftParams) -> None:
        self.params = params
        self._sift = cv2.SIFT_create(  # type: ignore[attr-defined]
            nfeatures=params.max_features,
            contrastThreshold=params.contrast_threshold,
            edgeThreshold=params.edge_threshold,
            enable_precise_upscale=True,  # otherwise all points are a quarter of a pixel off
        )

    def extract(self, image: Image) -> Features:
        """Returns the features of an (H, W, 3) picture: descriptors (N, 128) of length 1.

        Descriptors are square roots of SIFT's, divided by their sum (Arandjelovic and Zisserman, CVPR 2012):
        their dot product is the Hellinger kernel of SIFT's.

        Raises:
            RenderingError: The picture is no such array.
        """
        grey = cv2.cvtColor(check_image(image), cv2.COLOR_RGB2GRAY)
        points, raw = self._sift.detectAndCompute(grey, None)
        descriptors = np.zeros((0, 128)) if raw is None else raw.astype(np.float64)
        descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12))
        # OpenCV calls the first pixel's centre 0; SIFT's sub-pixel fit may step over the border by a little.
        places = np.array([point.pt for point in points], dtype=np.float64).reshape(-1, 2) + 0.5
        size = (image.shape[1], image.shape[0])
        return Features(
            keypoints=np.clip(places, 0.0, size).astype(np.float32),
            descriptors=descriptors.astype(np.float32),
            scores=np.array([point.response for point in points], dtype=np.float32),
            size=size,
        )


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
            one, two = (np.linalg.norm(some - those[neighbours], axis=1) for neighbours in (nearest, second))
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
