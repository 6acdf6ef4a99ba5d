"""The U-shaped network: how well a wireframe's line fits each place of a photo, at three scales."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lodbench.segmentation.nets.unets import STRIDE, CompactNet
from lodbench.segmentation.nets.weights import load_weights
from lodbench.segmentation.packaged import packaged_weights

# Channels of the trunk at a quarter and at half of the photo's size: its encoder's and its decoder's.
_QUARTER, _HALF = 40 + 48, 16 + 24


class Features(NamedTuple):
    """What the trunk makes of photos: (B, 88, H / 4, W / 4) and (B, 40, H / 2, W / 2)."""

    quarter: Tensor
    half: Tensor


class WireframeNet(nn.Module):
    """The encoder and decoder of segmenter compact, as trained for it, and heads that are trained here.

    Photos come in as (B, 3, H, W) float32 RGB in [0, 1], sides multiples of 32. Out comes, as a tuple of one,
    (B, 10, H / 2, W / 2), which ``unpacked`` here and in ``likelihood`` take apart: channel 0 the map at a
    quarter of the size, each value four times; 1 that at half; 2 to 5 that of full size, squares of two by
    two pixels; 6 to 9 the same of the map that poses are refined on.
    """

    def __init__(self, trunk: CompactNet | None = None) -> None:
        super().__init__()
        trunk = trunk or CompactNet()
        self.stem, self.stages, self.merges = trunk.stem, trunk.stages, trunk.merges
        self.coarse_head = nn.Sequential(
            nn.Conv2d(_QUARTER, 32, 1),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, 1, 3, padding=1),
        )
        self.fine_head = nn.Sequential(
            nn.Conv2d(_HALF, 32, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, 9, 3, padding=1),
        )
        self.enlarge = nn.Upsample(scale_factor=2, mode="nearest")

    def features(self, photos: Tensor) -> Features:
        """Returns what the trunk makes of photos."""
        kept = [self.stem((photos - 0.45) * 4.0)]
        for stage in self.stages:
            kept.append(stage(kept[-1]))
        stem, first, merged = kept[0], kept[1], kept.pop()
        quarter = merged
        for merge in self.merges:
            quarter, merged = merged, merge(merged, kept.pop())
        return Features(torch.cat([first, quarter], dim=1), torch.cat([stem, merged], dim=1))

    def heads(self, features: Features) -> Tensor:
        """Returns the packed maps."""
        return torch.cat(
            [self.enlarge(self.coarse_head(features.quarter)), self.fine_head(features.half)], dim=1
        )

    def forward(self, photos: Tensor) -> tuple[Tensor, ...]:
        """Returns the packed maps of photos, see the class."""
        return (self.heads(self.features(photos)),)


def unpacked(packed: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns the maps (B, h, w) at a quarter, a half and full size, and the one to refine on, full size."""
    full = nn.functional.pixel_shuffle(packed[:, 2:6], 2)
    refine = nn.functional.pixel_shuffle(packed[:, 6:10], 2)
    return packed[:, 0, ::2, ::2], packed[:, 1], full[:, 0], refine[:, 0]


def start_from(init: str | None) -> WireframeNet:
    """Returns a network to train: from a checkpoint of its own, else on the trunk of segmenter compact.

    Raises:
        ConfigError: The file holds no weights of this network.
    """
    if init is None:
        return WireframeNet(load_weights(CompactNet(), packaged_weights(), stride=STRIDE))
    return load_weights(WireframeNet(), init)
