"""``roma``: RoMa (Edstedt et al., CVPR 2024), a dense matcher, as romatch has it; weights from files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError, require_within
from lodbench.extras import require
from lodbench.matching.protocol import IMAGES, Image, Matches, check_image
from lodbench.segmentation.weight_files import RANDOM, Published, fetched_files

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

        from lodbench.segmentation.nets.weights import fill, read_weights

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
            fill(part, read_weights(file), str(file))
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
