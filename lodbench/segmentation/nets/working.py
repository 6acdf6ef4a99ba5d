"""Pictures brought to sides that a network takes."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor


def padded(images: Tensor, stride: int) -> tuple[Tensor, tuple[int, int]]:
    """Returns (B, C, H, W) with its last row and column repeated up to multiples of a stride, and (H, W)."""
    height, width = images.shape[-2:]
    below, right = -height % stride, -width % stride
    return F.pad(images, (0, right, 0, below), mode="replicate"), (height, width)
