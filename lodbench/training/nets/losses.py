"""Losses of SAM2-UNet: binary cross-entropy and IoU, both heavier near outlines (paper, equation 5)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

# Side of the window that says how near an outline is, pixels.
_WINDOW = 31


def outline_weights(truth: Tensor) -> Tensor:
    """Returns 1 + 5 |mean of the surroundings - truth|, of (B, 1, H, W) masks: 1 to 6."""
    reach = _WINDOW // 2
    # One axis after the other: 62 additions a pixel instead of 961.
    rows = F.avg_pool2d(truth, (_WINDOW, 1), stride=1, padding=(reach, 0))
    mean = F.avg_pool2d(rows, (1, _WINDOW), stride=1, padding=(0, reach))
    return 1 + 5 * (mean - truth).abs()


def structure_loss(logits: Tensor, truth: Tensor, weighting: str) -> Tensor:
    """Returns the mean over a batch of weighted cross-entropy plus weighted IoU loss.

    Args:
        logits: (B, 1, H, W).
        truth: (B, 1, H, W) in [0, 1]; soft at edges.
        weighting: ``paper``; or ``released``, whose cross-entropy is the plain mean over the batch,
            because the published code passes ``reduce`` where ``reduction`` is meant.
    """
    weights = outline_weights(truth)
    if weighting == "paper":
        each = F.binary_cross_entropy_with_logits(logits, truth, reduction="none")
        entropy = (weights * each).sum(dim=(2, 3)) / weights.sum(dim=(2, 3))
    else:
        entropy = F.binary_cross_entropy_with_logits(logits, truth)
    probability = torch.sigmoid(logits)
    shared = (probability * truth * weights).sum(dim=(2, 3))
    both = ((probability + truth) * weights).sum(dim=(2, 3))
    iou = 1 - (shared + 1) / (both - shared + 1)
    return (entropy + iou).mean()


def total_loss(outputs: tuple[Tensor, ...], truth: Tensor, weighting: str) -> Tensor:
    """Returns the sum of the losses of all heads: deep supervision."""
    losses = [structure_loss(logits.float(), truth, weighting) for logits in outputs]
    return torch.stack(losses).sum()
