"""What a segmenter is, and how its answer becomes the mask that is compared."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Entry

# A pixel is building from here on (the paper's delta_s).
BUILDING_THRESHOLD = 0.5


class Segmenter(Protocol):
    """Says where the buildings are in a query."""

    name: str

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the (H, W) float32 probability of building, in [0, 1].

        Raises:
            QueryFault: This query cannot be segmented; the reason becomes its row's.
        """
        ...

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns a digest of all that the answers to these queries depend on."""
        ...


def binary_mask(probability: NDArray[np.float32], width: int, height: int) -> NDArray[np.bool_]:
    """Returns the (height, width) mask: averaged over each target pixel's area, then thresholded."""
    import cv2

    if probability.shape == (height, width):
        return np.asarray(probability >= BUILDING_THRESHOLD)
    resized = cv2.resize(probability, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized >= BUILDING_THRESHOLD)
