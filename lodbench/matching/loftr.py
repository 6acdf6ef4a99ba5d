"""``loftr``: LoFTR (Sun et al., CVPR 2021) as kornia has it; weights from a file."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.errors import ConfigError
from lodbench.extras import require
from lodbench.matching.picture_pair import make_pair
from lodbench.matching.protocol import IMAGES, Image, Matches
from lodbench.matching.transformers_matchers import PairParams
from lodbench.matching.weights import RANDOM, named_file

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
        self._file = None if params.weights == RANDOM else named_file(params.weights)

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
