"""Whole pictures described by dense features, averaged over their parts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from .features import open_features

# Rows and columns that features are averaged in.
_ROWS, _COLUMNS = 6, 8


@dataclass(frozen=True, slots=True)
class PooledParams:
    """Settings of pooled features.

    Attributes:
        weights: As for ``method=mcloc``.
    """

    weights: str | None = None


class PooledFeatures:
    """Dense features of ``mcloc``, averaged in 6 x 8 parts of the picture, one after the other."""

    params_type = PooledParams
    features: ClassVar[str]

    def __init__(self, params: PooledParams) -> None:
        self._features = open_features(self.features, params.weights)

    def weight_files(self) -> list[Path]:
        """Returns the files of the features' weights."""
        return self._features.weight_files()

    def describe(self, pictures: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns (N, D) descriptors of length 1; of 0 where a picture has no feature."""
        features = self._features(pictures)
        parts = [
            part.mean(axis=(1, 2))
            for rows in np.array_split(features, _ROWS, axis=1)
            for part in np.array_split(rows, _COLUMNS, axis=2)
            if part.size
        ]
        joined = np.concatenate(parts, axis=1)
        length = np.maximum(np.linalg.norm(joined, axis=1, keepdims=True), 1e-6)
        return np.asarray(joined / length, dtype=np.float32)


class HogRetrieval(PooledFeatures):
    """Of histograms of directions; no weights."""

    features = "hog"


class XFeatRetrieval(PooledFeatures):
    """Of XFeat's descriptors."""

    features = "xfeat"


class Dinov2Retrieval(PooledFeatures):
    """Of DINOv2's patch tokens."""

    features = "dinov2"
