"""Learned matchers: SuperGlue, LightGlue on two features, E-LoFTR, MatchAnything (transformers), RoMa.

Networks are built from their published configuration; weights are looked for where they were fetched to,
never fetched. No image processor is used: those of several of these networks want torchvision. ``roma``
(Edstedt et al., CVPR 2024) is dense, as romatch has it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError, require_within
from lodbench.extras import require
from lodbench.matching.protocol import IMAGES, Image, Matches, check_image, make_pair
from lodbench.segmentation.weight_files import RANDOM, Published, fetched_files, fetched_folder, weights_file

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
            prediction = self._net(blob)
        # Places are shares of the picture's size.
        size = np.array(pair.pictures.shape[2:0:-1], np.float32)
        places = prediction.keypoints[0].float().numpy() * size
        there, scores = prediction.matches[0].long().numpy(), prediction.matching_scores[0].float().numpy()
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

        from lodbench.segmentation.nets.weights import load_weights

        torch.manual_seed(0)
        net = LoFTR(pretrained=None)
        load_weights(
            net, self._file, lambda stored: {name.removeprefix("matcher."): w for name, w in stored.items()}
        )
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
            correspondences = self._net({"image0": blobs[0], "image1": blobs[1]})
        score = correspondences["confidence"].float().numpy()
        first_px, in_first = pair.original(correspondences["keypoints0"].numpy(), 0)
        second_px, in_second = pair.original(correspondences["keypoints1"].numpy(), 1)
        kept = in_first & in_second & (score >= self.params.threshold)
        return Matches(first_px[kept], second_px[kept], score[kept].astype(np.float32))


# A copy of the authors' two files, which they publish at addresses of their own: so it is pinned.
_HUB_ID = "xboix/roma-outdoor"
_MATCHER, _DINOV2 = "roma_outdoor.pth", "dinov2_vitl14_pretrain.pth"
_PUBLISHED = {
    _MATCHER: Published(_HUB_ID, "RoMa MIT", 446),
    _DINOV2: Published(_HUB_ID, "DINOv2 Apache-2.0", 1218),
}
_DIGESTS = (
    "c7a45c80d41ad788a63c641d1b686d7cb3f297f40097c6f4e75039889e5cc8ba",
    "d5383ea8f4877b2472eb973e0fd72d557c7da5d3611bd527ceeb1d7162cbf428",
)
_PATCH = 14  # pixels: DINOv2 sees sides of whole patches
# As the authors': of so many more matches the final ones are drawn, those in crowds less often.
_SURPLUS, _CROWD_SPREAD, _FEWEST_NEAR = 4, 0.1, 10


@dataclass(frozen=True, slots=True)
class RomaParams:
    """Settings of RoMa.

    Attributes:
        weights: A folder of, or hub id fetched before with, ``roma_outdoor.pth`` and
            ``dinov2_vitl14_pretrain.pth``; ``random``; or None for the published ones.
        size: Side of the square that both pictures are squeezed into, pixels: whole patches of 14.
        fine_size: Side of the square in which what was found is refined.
        threshold: Least certainty of a match.
        max_matches: At most this many, spread over the picture.
    """

    weights: str | None = None
    size: int = 560
    fine_size: int = 864
    threshold: float = 0.05
    max_matches: int = 2048

    def __post_init__(self) -> None:
        if self.size % _PATCH or not 56 <= self.size <= 2240 or not 56 <= self.fine_size <= 4096:
            raise ConfigError(f"size={self.size} is 56 to 2240 px by {_PATCH}, fine_size 56 to 4096 px.")
        require_within("threshold", self.threshold, 0, 1, "[)")
        require_within("max_matches", self.max_matches, 1)


def roma_files(weights: str | None, names: tuple[str, ...] = (_MATCHER, _DINOV2)) -> list[Path]:
    """Returns the files of RoMa's weights, the matcher's first.

    Args:
        weights: As for ``RomaParams``, not ``random``.
        names: Those that are needed.

    Raises:
        ConfigError: They are not there, or others.
    """
    pinned = f"{_HUB_ID}#sha256={'+'.join(_DIGESTS[: len(names)])}"
    return fetched_files(weights or pinned, {name: _PUBLISHED[name] for name in names})


def roma_encoder_file(weights: str | None) -> Path:
    """Returns the file that RoMa's convolutional encoder is in; see ``roma_files``."""
    return roma_files(weights, (_MATCHER,))[0]


class Roma:
    """Matches every place of two pictures; on a GPU where torch has one.

    Raises:
        ConfigError: romatch or its torchvision is not installed or does not work, or there are no weights.
    """

    params_type = RomaParams
    takes = IMAGES

    def __init__(self, params: RomaParams) -> None:
        for package in ("torch", "torchvision", "romatch"):
            require(package, "roma", "roma")
        self.params = params
        self._files = [] if params.weights == RANDOM else roma_files(params.weights)

    def weight_files(self) -> list[Path]:
        """Returns the files of its weights."""
        return self._files

    @cached_property
    def _net(self) -> Any:
        import torch
        from loguru import logger
        from romatch import roma_outdoor

        from lodbench.segmentation.nets.weights import load_weights

        logger.disable("romatch")
        torch.manual_seed(0)
        with _built_unfilled():
            net = roma_outdoor(
                device="cuda" if torch.cuda.is_available() else "cpu",
                weights={},
                dinov2_weights={},
                coarse_res=self.params.size,
                upsample_res=self.params.fine_size,
                use_custom_corr=False,  # a CUDA extension that PyPI does not build
            )
        # romatch hides DINOv2 from the network's own parameters.
        for part, file in zip((net, net.encoder.dinov2_vitl14[0]), self._files, strict=False):
            load_weights(part, file)
        return net.eval()

    def match(self, first: Image, second: Image) -> Matches:
        """Returns the matches of two (H, W, 3) uint8 pictures; the score is their certainty.

        Raises:
            RenderingError: A picture is no such array.
        """
        from PIL import Image as Pillow

        pair = [check_image(first), check_image(second)]
        warp, certainty = self._net.match(*(Pillow.fromarray(image) for image in pair))
        places, sure = warp.reshape(-1, 4).float().cpu().numpy(), certainty.reshape(-1).float().cpu().numpy()
        kept = np.flatnonzero((sure >= self.params.threshold) & (np.abs(places) < 1).all(axis=1))
        kept = kept[self._spread(places[kept])]
        # Places run from -1 to 1 between the outer sides of the first and last pixel.
        sides = np.array([side for image in pair for side in image.shape[1::-1]], np.float32)
        pixels = (places[kept] + np.float32(1)) / np.float32(2) * sides
        return Matches(pixels[:, :2], pixels[:, 2:], sure[kept])

    def _spread(self, places: NDArray[np.float32]) -> NDArray[np.int64]:
        """Returns which of (N, 4) matches to take: at random, the same each time, spread over the pictures.

        romatch's own choice draws from torch's one stream of random numbers and fails where nothing is sure.
        """
        import torch
        from romatch.utils.kde import kde

        generator = np.random.default_rng(0)
        count = self.params.max_matches
        drawn = generator.permutation(len(places))[: _SURPLUS * count]
        if len(drawn) <= count:
            return np.sort(drawn)
        near = kde(torch.from_numpy(places[drawn]), std=_CROWD_SPREAD, half=False).numpy().astype(float)
        share = np.where(near < _FEWEST_NEAR, 1e-7, 1 / (near + 1))
        return np.sort(generator.choice(drawn, count, replace=False, p=share / share.sum()))


@contextmanager
def _built_unfilled() -> Iterator[None]:
    """Lets romatch build its networks as they are: its constructors load weights whatever they are given."""
    from romatch.models.matcher import RegressionMatcher
    from romatch.models.transformer.dinov2 import DinoVisionTransformer

    kinds = (RegressionMatcher, DinoVisionTransformer)
    for kind in kinds:
        kind.load_state_dict = lambda self, weights: None
    try:
        yield
    finally:
        for kind in kinds:
            del kind.load_state_dict
