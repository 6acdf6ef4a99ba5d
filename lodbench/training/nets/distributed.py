"""Several GPUs by torch's own means: one process each, started by ``torchrun``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import distributed, nn

from lodbench.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Place:
    """Where this process stands.

    Attributes:
        rank: Number of the process; 0 validates and writes.
        ranks: How many there are.
        device: What it computes on.
    """

    rank: int
    ranks: int
    device: torch.device

    def wrapped(self, net: nn.Module) -> nn.Module:
        """Returns a network that averages its gradients over all processes."""
        if self.ranks == 1:
            return net
        on_gpu = self.device.type == "cuda"
        net = nn.SyncBatchNorm.convert_sync_batchnorm(net) if on_gpu else net
        return nn.parallel.DistributedDataParallel(net, [self.device.index] if on_gpu else None)

    def mean(self, value: float) -> float:
        """Returns the mean of a value over all processes; each of them has to ask."""
        if self.ranks == 1:
            return value
        total = torch.tensor(value, dtype=torch.float64, device=self.device)
        distributed.all_reduce(total)
        return float(total) / self.ranks


@contextmanager
def joined(wanted: str) -> Iterator[Place]:
    """Gives the place of this process among those that ``torchrun`` started; alone without it.

    Raises:
        ConfigError: The device is not there.
    """
    rank, ranks = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    local = int(os.environ.get("LOCAL_RANK", "0"))
    device = _device(wanted, local)
    if ranks > 1:
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        yield Place(rank, ranks, device)
    finally:
        if ranks > 1:
            distributed.destroy_process_group()


def _device(wanted: str, local: int) -> torch.device:
    if wanted == "auto":
        wanted = f"cuda:{local}" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(wanted)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f"device={wanted} is not there.", "device=cpu is.") from error
    return device
