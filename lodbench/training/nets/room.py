"""Whether a step of training fits into memory, before the system ends the process without a word."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.func import functional_call

from lodbench.segmentation.memory import require_memory

# Beside what is kept for the way back a step holds what it is just computing: measured, up to a half of it.
_WORKING = 1.25
# A gradient and the two averages of AdamW for every weight that learns.
_PER_LEARNING = 3


def require_room(net: nn.Module, shape: tuple[int, int, int, int]) -> None:
    """Makes sure that a step over a batch fits into memory beside the network, which is there already.

    Args:
        net: As it will be trained.
        shape: (B, 3, H, W) of a batch.

    Raises:
        ConfigError: It does not.
    """
    learning = sum(p.numel() * p.element_size() for p in net.parameters() if p.requires_grad)
    needed = _PER_LEARNING * learning + _WORKING * kept_bytes(net, shape)
    count, _, height, width = shape
    what = f"Training steps over {count} pictures of {width} x {height}"
    require_memory(what, needed, "a smaller schedule.batch, schedule.size or segmenter.encoder")


def kept_bytes(net: nn.Module, shape: tuple[int, int, int, int]) -> int:
    """Returns what a step forward keeps for the way back, besides the weights; nothing is computed for it."""
    named = {
        **{key: p.detach().to("meta").requires_grad_(p.requires_grad) for key, p in net.named_parameters()},
        **{key: buffer.to("meta") for key, buffer in net.named_buffers()},
    }
    own = {tensor.untyped_storage()._cdata for tensor in named.values()}
    kept = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        kept[storage._cdata] = storage
        return tensor

    with (
        torch.random.fork_rng(devices=[]),
        torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor),
    ):
        functional_call(net, named, (torch.empty(shape, device="meta"),))
    return sum(storage.nbytes() for key, storage in kept.items() if key not in own)
