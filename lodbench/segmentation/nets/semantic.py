"""A semantic network's classes as one logit: some against all others."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class OneAgainstRest(nn.Module):
    """Photos (B, 3, H, W) in [0, 1] come in, a tuple of one, logits (B, 1, H, W), out.

    The sigmoid of the logit is the sum of the classes' softmax; the one class of a network that has no other
    is a logit already.

    Args:
        model: Answers with ``logits`` (B, classes, h, w) to normalised pictures.
        classes: Indices of the classes that count.
        mean: Of the pictures, red first.
        deviation: Likewise.
    """

    def __init__(
        self, model: nn.Module, classes: list[int], mean: Sequence[float], deviation: Sequence[float]
    ) -> None:
        super().__init__()
        self.model = model
        self.classes = classes
        self.register_buffer("mean", torch.tensor(mean)[:, None, None], persistent=False)
        self.register_buffer("deviation", torch.tensor(deviation)[:, None, None], persistent=False)

    def forward(self, photos: Tensor) -> tuple[Tensor, ...]:
        """Returns the logits at the photos' size."""
        scores = self.model((photos - self.mean) / self.deviation).logits
        scores = F.interpolate(scores, size=photos.shape[-2:], mode="bilinear")
        if scores.shape[1] == 1:
            return (scores,)
        rest = [k for k in range(scores.shape[1]) if k not in self.classes]
        wanted = scores[:, self.classes].logsumexp(dim=1, keepdim=True)
        return (wanted - scores[:, rest].logsumexp(dim=1, keepdim=True),)
