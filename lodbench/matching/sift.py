"""``sift``: Lowe's features (IJCV 2004) as OpenCV computes them, descriptors as RootSIFT's."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lodbench.errors import require_numbers, require_within
from lodbench.matching.protocol import Features, Image, check_image


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
        points, found = self._sift.detectAndCompute(grey, None)
        descriptors = np.zeros((0, 128)) if found is None else found.astype(np.float64)
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
