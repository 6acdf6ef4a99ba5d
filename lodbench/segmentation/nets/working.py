"""Pictures brought to sides that a network takes."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn


class Padding(nn.Module):
    """A network that takes pictures of any size: they are padded for it, and its answers cut back.

    Args:
        net: Takes (B, C, H, W) and returns a tuple of (B, 1, H, W).
        stride: What its H and W are multiples of.
    """

    def __init__(self, net: nn.Module, stride: int) -> None:
        super().__init__()
        self.net, self.stride = net, stride

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        """Returns the network's answers, (B, 1, H, W) each, to pictures (B, C, H, W)."""
        height, width = images.shape[-2:]
        return tuple(answer[..., :height, :width] for answer in self.net(_padded(images, self.stride)))


def _padded(images: Tensor, stride: int) -> Tensor:
    """Returns (B, C, H, W) with its last row and column repeated up to multiples of a stride."""
    below, right = (-side % stride for side in images.shape[-2:])
    return F.pad(images, (0, right, 0, below), mode="replicate") if below or right else images
