"""Where a training starts from weights it was given: the first step shall find what they know."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn


class _Moments:
    """Mean and variance of what enters a normalisation, per channel."""

    def __init__(self) -> None:
        self.batches = 0
        self.mean: Tensor = torch.zeros(())
        self.square: Tensor = torch.zeros(())

    def take(self, _norm: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        values = inputs[0].float()
        self.batches += 1
        self.mean = self.mean + values.mean(dim=(0, 2, 3))
        self.square = self.square + (values**2).mean(dim=(0, 2, 3))

    def result(self) -> tuple[Tensor, Tensor]:
        mean = self.mean / self.batches
        return mean, (self.square / self.batches - mean**2).clamp_min(0)


@torch.no_grad()
def adapt_norms(net: nn.Module, batches: Iterable[Tensor]) -> None:
    """Brings the statistics of batch normalisations to some pictures; the network's answers stay.

    While it trains, a network normalises by the batch at hand. Weights from other pictures, or from an export
    that has folded the statistics away, would answer something else at once; so scale and shift of each
    normalisation take up the difference.

    Args:
        net: Changed in place.
        batches: (B, 3, H, W) pictures.
    """
    norms = {norm: _Moments() for norm in net.modules() if isinstance(norm, nn.BatchNorm2d)}
    if not norms:
        return
    hooks = [norm.register_forward_pre_hook(moments.take) for norm, moments in norms.items()]
    net.eval()
    for images in batches:
        net(images)
    for hook in hooks:
        hook.remove()
    for norm, moments in norms.items():
        if moments.batches == 0:  # part of the network, but not of its answer
            continue
        mean, variance = moments.result()
        old_mean, old_variance = norm.get_buffer("running_mean"), norm.get_buffer("running_var")
        factor = norm.weight / (old_variance + norm.eps).sqrt()
        norm.bias += factor * (mean - old_mean)
        norm.weight.copy_(factor * (variance + norm.eps).sqrt())
        old_mean.copy_(mean)
        old_variance.copy_(variance)
