"""The mean of several trainings' weights: better than each where they share their start."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import nn

from lodbench.segmentation.nets.weights import fill, read_weights


@torch.no_grad()
def average_into(net: nn.Module, others: Sequence[Path]) -> None:
    """Gives a network the mean of its own weights and those of others (Wortsman et al., ICML 2022).

    Args:
        net: Changed in place.
        others: Checkpoints of trainings of the same network that went out from the same weights.

    Raises:
        ConfigError: A file is missing or holds weights of another network.
    """
    total = {name: value.clone() for name, value in net.state_dict().items()}
    for path in others:
        fill(net, read_weights(path), str(path))
        for name, value in net.state_dict().items():
            total[name] += value
    for name, value in total.items():
        mean = value / (1 + len(others))
        total[name] = mean.to(value.dtype)
    net.load_state_dict(total)
