"""``compact``: a small network for one core, photo to building logits, trained on synthetic pictures."""

from __future__ import annotations

import torch
from torch import Tensor, nn

# Both sides of the input are a multiple of this; the smallest features are that much smaller.
STRIDE = 32


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _conv(channels, channels)
        self.second = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        )

    def forward(self, features: Tensor) -> Tensor:
        return torch.relu(features + self.second(self.first(features)))


def _stage(inputs: int, outputs: int, blocks: int) -> nn.Sequential:
    return nn.Sequential(_conv(inputs, outputs, stride=2), *(_Residual(outputs) for _ in range(blocks)))


class _Merge(nn.Module):
    """Doubles coarse features and adds finer ones, brought to as many channels."""

    def __init__(self, coarse: int, fine: int, outputs: int) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(coarse, outputs, 1, bias=False)
        self.lateral = nn.Conv2d(fine, outputs, 1, bias=False)
        self.norm = nn.Sequential(nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))
        self.fuse = _conv(outputs, outputs)
        self.enlarge = nn.Upsample(scale_factor=2, mode="nearest")

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        fused: Tensor = self.fuse(self.norm(self.enlarge(self.reduce(coarse)) + self.lateral(fine)))
        return fused


class CompactNet(nn.Module):
    """A U-shaped residual network, 1.5 million weights; every operation has an ONNX and OpenCV form.

    Photos come in as (B, 3, H, W) float32 RGB in [0, 1], sides multiples of ``STRIDE``; out come, as a
    tuple of one, logits (B, channels, H, W). Plain 3 x 3 convolutions: one core runs them near its peak.

    Args:
        channels: One, buildings against all else; or one per class, against a last class whose logit is 0.
    """

    def __init__(self, channels: int = 1) -> None:
        super().__init__()
        widths = (16, 40, 72, 112, 144)
        self.stem = _conv(3, widths[0], stride=2)
        self.stages = nn.ModuleList(
            _stage(widths[k], widths[k + 1], blocks) for k, blocks in enumerate((1, 2, 2, 1))
        )
        self.merges = nn.ModuleList(
            [_Merge(144, 112, 96), _Merge(96, 72, 64), _Merge(64, 40, 48), _Merge(48, 16, 24)]
        )
        # The last doubling rearranges four channels into a square of pixels.
        self.head = nn.Sequential(nn.Conv2d(24, 4 * channels, 3, padding=1), nn.PixelShuffle(2))

    def forward(self, photos: Tensor) -> tuple[Tensor, ...]:
        """Returns the logits of photos, see the class."""
        features = [self.stem((photos - 0.45) * 4.0)]
        for stage in self.stages:
            features.append(stage(features[-1]))
        merged = features.pop()
        for merge in self.merges:
            merged = merge(merged, features.pop())
        return (self.head(merged),)
