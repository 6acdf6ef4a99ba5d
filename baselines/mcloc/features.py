"""Dense features of pictures: at each place of a coarse grid a vector of length 1, or 0 where nothing is."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError
from lodbench.extras import require
from lodbench.matching import open_extractor
from lodbench.matching.learned_matchers import roma_encoder_file
from lodbench.segmentation.weight_files import Published, fetched_folder

Pictures = NDArray[np.uint8]
FeatureMaps = NDArray[np.float32]

_RANDOM = "random"
_DINOV2 = Published("facebook/dinov2-small", "Apache-2.0", 88)
_PATCH = 14
# Of ImageNet's pictures, red first.
_MEAN, _SPREAD = (np.array(v, np.float32) for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))


class DenseFeatures(Protocol):
    """Features of pictures of one size."""

    def __call__(self, pictures: Pictures) -> FeatureMaps:
        """Returns (N, h, w, C) features of (N, H, W, 3) pictures, red first."""
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

    def __call__(self, pictures: Pictures) -> FeatureMaps:
        """Returns (N, H / cell, W / cell, 9) histograms, each pixel shared by the two nearest directions."""
        return np.stack([self._of(picture) for picture in pictures])

    def _of(self, picture: NDArray[np.uint8]) -> NDArray[np.float32]:
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

    def __call__(self, pictures: Pictures) -> FeatureMaps:
        """Returns (N, h, w, 64) descriptors."""
        return np.asarray(self._extractor.dense(pictures), dtype=np.float32)


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

    def __call__(self, pictures: Pictures) -> FeatureMaps:
        """Returns (N, h, w, 384) patch tokens of pictures cut to whole patches."""
        import torch

        height, width = (side // _PATCH * _PATCH for side in pictures.shape[1:3])
        if not height or not width:
            raise ConfigError(f"method.fine_size and coarse_size are at least {_PATCH} px for dinov2.")
        blob = torch.from_numpy(_normalised(pictures[:, :height, :width]))
        with torch.inference_mode():
            tokens = self._net(blob).last_hidden_state[:, 1:].numpy()
        tokens = tokens / np.maximum(np.linalg.norm(tokens, axis=2, keepdims=True), 1e-12)
        sides = len(pictures), height // _PATCH, width // _PATCH, -1
        return np.asarray(tokens.reshape(sides), dtype=np.float32)


class RomaMap:
    """Features of the convolutional encoder of RoMa (Edstedt et al., CVPR 2024), one per eight pixels.

    It is VGG-19's first four blocks with batch normalisation, trained with the matcher; of RoMa's weights the
    file of the matcher is enough, and neither romatch nor torchvision is needed.

    Raises:
        ConfigError: torch is not installed, or the weights have not been fetched.
    """

    blocks = ((64, 2), (128, 2), (256, 4), (512, 4))

    def __init__(self, weights: str | None) -> None:
        require("torch", "torch", "mcloc features=roma")
        import torch

        from lodbench.segmentation.nets.weights import load_weights

        torch.manual_seed(0)
        self._file = None if weights == _RANDOM else roma_encoder_file(weights)
        name = "encoder.cnn.layers."
        self._net = load_weights(
            self._unfilled(),
            self._file,
            lambda stored: {key.removeprefix(name): w for key, w in stored.items() if key.startswith(name)},
        ).eval()

    def _unfilled(self) -> Any:
        from torch import nn

        layers: list[nn.Module] = []
        channels = 3
        for wide, depth in self.blocks:
            layers += [nn.MaxPool2d(2)] if layers else []
            for _ in range(depth):
                layers += [
                    nn.Conv2d(channels, wide, 3, padding=1),
                    nn.BatchNorm2d(wide),
                    nn.ReLU(inplace=True),
                ]
                channels = wide
        return nn.Sequential(*layers)

    def weight_files(self) -> list[Path]:
        """Returns the file of the matcher's weights."""
        return [] if self._file is None else [self._file]

    def __call__(self, pictures: Pictures) -> FeatureMaps:
        """Returns (N, H / 8, W / 8, 512) features."""
        import torch

        with torch.inference_mode():
            features = self._net(torch.from_numpy(_normalised(pictures))).numpy()
        features = features.transpose(0, 2, 3, 1)
        length = np.maximum(np.linalg.norm(features, axis=3, keepdims=True), 1e-12)
        return np.asarray(features / length, dtype=np.float32)


def _normalised(pictures: Pictures) -> NDArray[np.float32]:
    """Returns (N, 3, H, W) float32 of (N, H, W, 3) pictures, as networks trained on ImageNet want them."""
    pixels = (pictures.astype(np.float32) / np.float32(255) - _MEAN) / _SPREAD
    return np.ascontiguousarray(pixels.transpose(0, 3, 1, 2))


_NETWORKS: dict[str, Callable[[str | None], DenseFeatures]] = {
    "xfeat": XFeatMap,
    "dinov2": Dinov2Map,
    "roma": RomaMap,
}


@lru_cache(maxsize=2)
def open_features(name: str, weights: str | None) -> DenseFeatures:
    """Returns the features of a name, opened once in a process: they may hold a network."""
    return Hog() if name == "hog" else _NETWORKS[name](weights)


def similarities(photo: FeatureMaps, renders: FeatureMaps) -> NDArray[np.float64]:
    """Returns minus the mean distance of (h, w, C) features to each of N: 0 for equal ones, above -2."""
    apart = np.linalg.norm(renders - photo, axis=3).mean(axis=(1, 2), dtype=np.float64)
    return np.asarray(-apart, dtype=np.float64)
