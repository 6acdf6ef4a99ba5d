"""Learned matchers of transformers: SuperGlue, LightGlue on two features, E-LoFTR, MatchAnything.

Networks are built from their published configuration; weights are looked for where they were fetched
to, never fetched. No image processor is used: those of several of these networks want torchvision.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lodbench.errors import ConfigError, require_within
from lodbench.extras import require
from lodbench.matching.protocol import IMAGES, Image, Matches, make_pair
from lodbench.segmentation.weight_files import RANDOM, Published, fetched_folder, weights_file

_MAGIC_LEAP = "Magic Leap's licence: research, not commercial"


@dataclass(frozen=True, slots=True)
class PairParams:
    """Settings of a network that matches two pictures.

    Attributes:
        weights: A folder or hub id fetched before, ``random``, or None for the published ones.
        size: Longest side of the pictures it sees, pixels.
        threshold: Least score of a match.
    """

    weights: str | None = None
    size: int = 1024
    threshold: float = 0.2

    def __post_init__(self) -> None:
        require_within("size", self.size, 32, 8192)
        require_within("threshold", self.threshold, 0, 1, "[)")


class TransformersMatcher:
    """Matches two pictures by a network of transformers.

    Raises:
        ConfigError: torch or transformers is not installed, or the weights have not been fetched.
    """

    params_type = PairParams
    takes = IMAGES
    published: ClassVar[Published]
    architecture: ClassVar[str]
    config: ClassVar[str]

    def __init__(self, params: PairParams) -> None:
        for package in ("torch", "transformers"):
            require(package, "models", self.architecture)
        self.params = params
        is_random = params.weights == RANDOM
        self._folder = None if is_random else fetched_folder(params.weights, self.published)

    def weight_files(self) -> list[Path]:
        """Returns the files of its weights."""
        return [] if self._folder is None else sorted(self._folder.glob("*.safetensors"))

    @cached_property
    def _net(self) -> Any:
        import torch
        import transformers

        torch.manual_seed(0)
        kind = getattr(transformers, self.architecture)
        if self._folder is None:
            return kind(self._random_config(getattr(transformers, self.config))).eval()
        return kind.from_pretrained(self._folder, local_files_only=True, use_safetensors=True).eval()

    def _random_config(self, kind: Any) -> Any:
        return kind()

    def match(self, first: Image, second: Image) -> Matches:
        """Returns the matches of two (H, W, 3) uint8 pictures; the score is the network's.

        Raises:
            RenderingError: A picture is no such array.
        """
        import torch

        pair = make_pair(first, second, self.params.size, 32)
        grey = pair.pictures @ np.array([0.2989, 0.5870, 0.1140], np.float32)
        blob = torch.from_numpy(np.repeat(grey[None, :, None], 3, axis=2))
        with torch.inference_mode():
            found = self._net(blob)
        # Places are shares of the picture's size.
        size = np.array(pair.pictures.shape[2:0:-1], np.float32)
        places = found.keypoints[0].float().numpy() * size
        there, scores = found.matches[0].long().numpy(), found.matching_scores[0].float().numpy()
        one, other, score = self._pairs(places, there, scores)
        first_px, in_first = pair.original(one, 0)
        second_px, in_second = pair.original(other, 1)
        kept = in_first & in_second & (score >= self.params.threshold)
        return Matches(first_px[kept], second_px[kept], score[kept].astype(np.float32))

    def _pairs(self, places: Any, there: Any, scores: Any) -> tuple[Any, Any, Any]:
        """Returns places in both pictures and scores: of sparse matchers a match is a number in the other."""
        here = np.flatnonzero((there[0] >= 0) & (there[0] < places.shape[1]))
        return places[0, here], places[1, there[0, here]], scores[0, here]


class SuperPointSuperGlue(TransformersMatcher):
    """SuperPoint (DeTone et al., 2018) and SuperGlue (Sarlin et al., CVPR 2020), outdoor weights."""

    published = Published("magic-leap-community/superglue_outdoor", _MAGIC_LEAP, 53)
    architecture, config = "SuperGlueForKeypointMatching", "SuperGlueConfig"

    def _random_config(self, kind: Any) -> Any:
        return kind(keypoint_detector_config={"model_type": "superpoint", "max_keypoints": 256})


class SuperPointLightGlue(TransformersMatcher):
    """LightGlue (Lindenberger et al., ICCV 2023) on SuperPoint."""

    published = Published("ETH-CVG/lightglue_superpoint", f"Apache-2.0; its SuperPoint {_MAGIC_LEAP}", 55)
    architecture, config = "LightGlueForKeypointMatching", "LightGlueConfig"

    def _random_config(self, kind: Any) -> Any:
        return kind(keypoint_detector_config={"model_type": "superpoint", "max_keypoints": 256})


class DiskLightGlue(SuperPointLightGlue):
    """LightGlue on DISK (Tyszkiewicz et al., NeurIPS 2020)."""

    published = Published("ETH-CVG/lightglue_disk", "Apache-2.0", 52)


class EfficientLoftr(TransformersMatcher):
    """E-LoFTR (Wang et al., CVPR 2024): semi-dense, no keypoints."""

    published = Published("zju-community/efficientloftr", "Apache-2.0", 64)
    architecture, config = "EfficientLoFTRForKeypointMatching", "EfficientLoFTRConfig"

    def _pairs(self, places: Any, there: Any, scores: Any) -> tuple[Any, Any, Any]:
        kept = (there[0] >= 0) & (there[1] >= 0)
        return places[0, kept], places[1, kept], scores[0, kept]


class MatchAnything(EfficientLoftr):
    """E-LoFTR with the weights of MatchAnything (He et al., 2025), trained across kinds of pictures."""

    published = Published("zju-community/matchanything_eloftr", "licence not stated where they lie", 64)


_CELL = 8


class Loftr:
    """Matches two pictures without keypoints.

    Raises:
        ConfigError: torch or kornia is not installed, or there is no file of weights.
    """

    params_type = PairParams
    takes = IMAGES

    def __init__(self, params: PairParams) -> None:
        for package in ("torch", "kornia"):
            require(package, "xfeat", "loftr")
        self.params = params
        if params.weights is None:
            raise ConfigError(
                "loftr has no weights: loftr_outdoor.ckpt (Apache-2.0, 46 MB) is fetched by hand.",
                "Its authors' page links it; then: `method.weights=FILE`.",
            )
        self._file = None if params.weights == RANDOM else weights_file(params.weights)

    def weight_files(self) -> list[Path]:
        """Returns the file of its weights."""
        return [] if self._file is None else [self._file]

    @cached_property
    def _net(self) -> Any:
        import torch
        from kornia.feature import LoFTR

        from lodbench.segmentation.nets.weights import fill, read_weights

        torch.manual_seed(0)
        net = LoFTR(pretrained=None)
        if self._file is not None:
            weights = {
                name.removeprefix("matcher."): value for name, value in read_weights(self._file).items()
            }
            fill(net, weights, str(self._file))
        return net.eval()

    def match(self, first: Image, second: Image) -> Matches:
        """Returns the matches of two (H, W, 3) uint8 pictures; the score is the network's confidence.

        Raises:
            RenderingError: A picture is no such array.
        """
        import torch

        pair = make_pair(first, second, self.params.size, _CELL)
        grey = pair.pictures @ np.array([0.2989, 0.5870, 0.1140], np.float32)
        blobs = torch.from_numpy(grey[:, None, None])
        with torch.inference_mode():
            found = self._net({"image0": blobs[0], "image1": blobs[1]})
        score = found["confidence"].float().numpy()
        first_px, in_first = pair.original(found["keypoints0"].numpy(), 0)
        second_px, in_second = pair.original(found["keypoints1"].numpy(), 1)
        kept = in_first & in_second & (score >= self.params.threshold)
        return Matches(first_px[kept], second_px[kept], score[kept].astype(np.float32))
