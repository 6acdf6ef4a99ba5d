"""Dense features of pictures: at each place of a coarse grid a vector of length 1, or 0 where nothing is."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError
from lodbench.matching import open_extractor
from lodbench.matching.weights import Published, fetched_folder
from lodbench.segmentation.extras import require

Picture = NDArray[np.uint8]
FeatureMap = NDArray[np.float32]

_RANDOM = "random"
_DINOV2 = Published("facebook/dinov2-small", "Apache-2.0", 88)
_PATCH = 14


class DenseFeatures(Protocol):
    """Features of a picture."""

    def __call__(self, picture: Picture) -> FeatureMap:
        """Returns (h, w, C) features of an (H, W, 3) picture, red first."""
        ...

    def weight_files(self) -> list[Path]:
        """Returns the files of their weights."""
        ...


class Hog:
    """Histograms of oriented gradients (Dalal and Triggs, CVPR 2005) of cells of so many pixels.

    Directions are those of lines, without a sign: a roof may be lighter or darker than the ground. A cell
    with hardly any gradient has none, by a floor on what histograms are divided by.
    """

    bins = 9

    def __init__(self, cell_px: int = 8, floor: float = 12.0) -> None:
        self.cell_px, self.floor = cell_px, floor

    def weight_files(self) -> list[Path]:
        """Returns none."""
        return []

    def __call__(self, picture: Picture) -> FeatureMap:
        """Returns (H / cell, W / cell, 9) histograms, each pixel shared by the two nearest directions."""
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
        across, down = cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)
        cell = self.cell_px
        rows, columns = (max(1, side // cell) for side in grey.shape)
        strength, angle = cv2.cartToPolar(across, down)
        place = (angle * np.float32(self.bins / np.pi))[: rows * cell, : columns * cell]
        strength = strength[: rows * cell, : columns * cell]
        low = np.floor(place)
        share = place - low
        down_cell, across_cell = np.arange(place.shape[0]) // cell, np.arange(place.shape[1]) // cell
        number = (down_cell[:, None] * columns + across_cell) * self.bins
        first = low.astype(np.int64) % self.bins
        count = rows * columns * self.bins
        sums = np.bincount((number + first).ravel(), (strength * (1 - share)).ravel(), count)
        sums += np.bincount((number + (first + 1) % self.bins).ravel(), (strength * share).ravel(), count)
        cells = (sums / cell**2).astype(np.float32).reshape(rows, columns, self.bins)
        length = np.sqrt((cells**2).sum(axis=2, keepdims=True) + np.float32(self.floor**2))
        return np.asarray(cells / length, dtype=np.float32)


class XFeatMap:
    """XFeat's dense descriptors, one per eight pixels; weights as for the matcher ``xfeat``."""

    def __init__(self, weights: str | None) -> None:
        self._extractor: Any = open_extractor("xfeat", weights=weights)

    def weight_files(self) -> list[Path]:
        """Returns XFeat's file."""
        return list(self._extractor.weight_files())

    def __call__(self, picture: Picture) -> FeatureMap:
        """Returns (h, w, 64) descriptors."""
        return np.asarray(self._extractor.dense(picture), dtype=np.float32)


class Dinov2Map:
    """DINOv2's patch tokens (Oquab et al., 2023), ViT-S/14, through transformers; Apache-2.0, 88 MB.

    Raises:
        ConfigError: transformers is not installed, or the weights have not been fetched.
    """

    def __init__(self, weights: str | None) -> None:
        for package in ("torch", "transformers"):
            require(package, "models", "mcloc features=dinov2")
        import torch
        from transformers import Dinov2Config, Dinov2Model

        torch.manual_seed(0)
        self._folder = None if weights == _RANDOM else fetched_folder(weights, _DINOV2)
        if self._folder is None:
            config = Dinov2Config(hidden_size=384, num_hidden_layers=12, num_attention_heads=6)
            self._net = Dinov2Model(config).eval()
        else:
            self._net = Dinov2Model.from_pretrained(self._folder, local_files_only=True).eval()

    def weight_files(self) -> list[Path]:
        """Returns the network's."""
        return [] if self._folder is None else sorted(self._folder.glob("*.safetensors"))

    def __call__(self, picture: Picture) -> FeatureMap:
        """Returns (h, w, 384) patch tokens of the picture cut to whole patches."""
        import torch

        height, width = (side // _PATCH * _PATCH for side in picture.shape[:2])
        if not height or not width:
            raise ConfigError(f"method.fine_size and coarse_size are at least {_PATCH} px for dinov2.")
        pixels = picture[:height, :width].astype(np.float32) / 255.0
        pixels = (pixels - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
        blob = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)[None], dtype=np.float32))
        with torch.inference_mode():
            tokens = self._net(blob).last_hidden_state[0, 1:].numpy()
        tokens = tokens / np.maximum(np.linalg.norm(tokens, axis=1, keepdims=True), 1e-12)
        return np.asarray(tokens.reshape(height // _PATCH, width // _PATCH, -1), dtype=np.float32)


@lru_cache(maxsize=2)
def open_features(name: str, weights: str | None) -> DenseFeatures:
    """Returns the features of a name, opened once in a process: they may hold a network."""
    if name == "hog":
        return Hog()
    return XFeatMap(weights) if name == "xfeat" else Dinov2Map(weights)


def similarity(photo: FeatureMap, render: FeatureMap) -> float:
    """Returns minus the mean distance of two feature maps of one size: 0 for equal ones, above -2."""
    return -float(np.linalg.norm(photo - render, axis=2).mean())
