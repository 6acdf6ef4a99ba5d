"""Checkpoints: everything a training goes on from, whole or not at all; nothing is unpickled."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import distributed, nn

from lodbench.errors import ConfigError
from lodbench.segmentation.nets.weights import read_torch_file
from lodbench.storage import write_bytes

CHECKPOINT_FILE = "checkpoint.pt"


def save_checkpoint(state: dict[str, Any], folder: Path) -> None:
    """Writes the checkpoint of a folder in place of the one there; equal states give the same bytes."""
    content = io.BytesIO()
    torch.save(_rebuilt(state), content)
    write_bytes(folder / CHECKPOINT_FILE, content.getvalue())


def _rebuilt(value: Any) -> Any:
    """Returns a value whose containers are its own and whose equal strings are one.

    The file tells one object met twice from two that are equal, and a state that was read back has
    other objects than one that was never stored.
    """
    if isinstance(value, dict):
        return {_rebuilt(key): _rebuilt(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_rebuilt(item) for item in value)
    return sys.intern(value) if isinstance(value, str) else value


def load_checkpoint(folder: Path, identity: str) -> dict[str, Any] | None:
    """Returns the checkpoint of a folder, or None where there is none.

    Raises:
        ConfigError: It cannot be read, or belongs to other settings, views or code.
    """
    path = folder / CHECKPOINT_FILE
    if not path.exists():
        return None
    try:
        state: dict[str, Any] = read_torch_file(path)
        found = state["identity"]
    except Exception as error:
        raise ConfigError(
            f"{path} is no checkpoint of lodbench train.", "Name another `out=FOLDER`."
        ) from error
    if found != identity:
        raise ConfigError(
            f"{folder} holds the training of other settings, other views or other code.",
            "Name another `out=FOLDER`, or set `resume=false` to start anew there.",
        )
    return state


@dataclass(frozen=True, slots=True)
class TrainingProcess:
    """Where this process stands."""

    rank: int  # number of the process; 0 validates and writes
    ranks: int  # how many there are
    device: torch.device  # what it computes on

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
def joined(wanted: str) -> Iterator[TrainingProcess]:
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
        yield TrainingProcess(rank, ranks, device)
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
