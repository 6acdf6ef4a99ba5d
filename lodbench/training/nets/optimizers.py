"""What moves the weights: AdamW, and Muon for the kernels of convolutions where it is wanted."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from lodbench.training.train_params import TrainParams

# A kernel from or to fewer channels is hardly a matrix: first and last layers stay with AdamW.
_LEAST_CHANNELS = 16
# Of Newton and Schulz's iteration as Muon has it, a polynomial: of the first, third and fifth degree.
_COEFFICIENTS = (3.4445, -4.775, 2.0315)
# Iterations that bring singular values near one; the usual fifth costs a fifth more and was not missed.
_ITERATIONS = 4
_MOMENTUM = 0.9
# A matrix shorter than this has no direction.
_SHORTEST = 1e-7


class KernelMuon(torch.optim.Optimizer):
    """Muon over kernels of convolutions, each taken as the matrix from its inputs to its outputs.

    Jordan et al., "Muon: an optimizer for hidden layers in neural networks" (2024). torch's own takes
    matrices only, and iterates in bfloat16: on CPUs without instructions for it 10 to 30 times as long as
    in float32, a third of all a training takes. The matrices here are views of the kernels, so that a step
    moves them.

    Args:
        kernels: (outputs, inputs, height, width) weights, on their device and in their final memory format.
        lr: Learning rate.
        weight_decay: Share of a weight that a step at rate 1 takes away.
    """

    def __init__(self, kernels: list[nn.Parameter], lr: float, weight_decay: float) -> None:
        matrices = [nn.Parameter(_matrix(kernel.data, kernel)) for kernel in kernels]
        super().__init__(matrices, {"lr": lr, "weight_decay": weight_decay})
        self._kernels, self._matrices = kernels, matrices

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """Moves the kernels by their gradients."""
        loss = None if closure is None else torch.enable_grad()(closure)()
        (group,) = self.param_groups
        for kernel, matrix in zip(self._kernels, self._matrices, strict=True):
            if kernel.grad is None:
                continue
            gradient, state = _matrix(kernel.grad, kernel), self.state[matrix]
            if "momentum_buffer" not in state:
                state["momentum_buffer"] = torch.zeros_like(gradient)
            mean = state["momentum_buffer"].lerp_(gradient, 1.0 - _MOMENTUM)
            ahead = gradient.lerp(mean, _MOMENTUM)
            # Entries of a tall matrix move as far as those of a square one with as many columns.
            rate = group["lr"] * math.sqrt(max(1.0, matrix.shape[0] / matrix.shape[1]))
            matrix.mul_(1.0 - group["lr"] * group["weight_decay"])
            matrix.add_(_orthogonalized(ahead), alpha=-rate)
        return loss


def _orthogonalized(matrix: Tensor) -> Tensor:
    """Returns a matrix with about the same singular vectors and all its singular values near one."""
    is_tall = matrix.shape[0] > matrix.shape[1]
    wide = matrix.T if is_tall else matrix
    wide = wide / wide.norm().clamp(min=_SHORTEST)
    first, third, fifth = _COEFFICIENTS
    for _ in range(_ITERATIONS):
        gram = wide @ wide.T
        wide = torch.addmm(wide, torch.addmm(gram, gram, gram, beta=third, alpha=fifth), wide, beta=first)
    return wide.T if is_tall else wide


def _matrix(values: Tensor, kernel: Tensor) -> Tensor:
    """Returns values of a kernel's shape as (outputs, rest), ordered so that the kernel's own are a view."""
    if not kernel.is_contiguous():
        values = values.permute(0, 2, 3, 1)
    return values.reshape(len(kernel), -1)


def make_optimizers(net: nn.Module, params: TrainParams) -> list[torch.optim.Optimizer]:
    """Returns the optimizers of all weights that are not frozen; an ``encoder_rate`` of 0 freezes some."""
    encoder = list(net.encoder.parameters()) if isinstance(getattr(net, "encoder", None), nn.Module) else []
    slow = {id(weight) for weight in encoder} if params.encoder_rate != 1 else set()
    for weight in encoder:
        weight.requires_grad_(weight.requires_grad and params.encoder_rate > 0)
    weights = [weight for weight in net.parameters() if weight.requires_grad]
    kernels = [
        w for w in weights if w.ndim == 4 and min(w.shape[:2]) >= _LEAST_CHANNELS and id(w) not in slow
    ]
    if params.optimizer == "adamw":
        kernels = []
    chosen = {id(kernel) for kernel in kernels} | slow
    others = [weight for weight in weights if id(weight) not in chosen]
    slowed = [weight for weight in weights if id(weight) in slow]
    groups = [{"params": others, "share": 1.0}]
    if slowed:
        groups.append({"params": slowed, "share": params.encoder_rate})
    made: list[torch.optim.Optimizer] = [
        torch.optim.AdamW(groups, lr=params.lr, weight_decay=params.weight_decay)
    ]
    if kernels:
        made.append(KernelMuon(kernels, params.muon_lr, params.weight_decay))
    return made


def set_rate(optimizers: list[torch.optim.Optimizer], share: float) -> None:
    """Sets the learning rates to a share of each optimizer's highest, and of each group's share of that."""
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            group["lr"] = share * group.get("share", 1.0) * optimizer.defaults["lr"]
