"""The training loop: exact to the step, resumable, the same numbers every time on a CPU."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lodbench.errors import ConfigError
from lodbench.execution import Progress
from lodbench.segmentation.nets.weights import Padding
from lodbench.training.nets.batches import (
    TrainingProcess,
    against_rest,
    batches,
    save_checkpoint,
    steps_per_epoch,
    validation_iou,
)
from lodbench.training.samples import Sample, TrainParams

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
        logits: (B, 1 or classes, H, W), each against all else.
        truth: Of that shape, in [0, 1]; soft at edges.
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
    losses = [structure_loss(against_rest(logits.float()), truth, weighting) for logits in outputs]
    return torch.stack(losses).sum()


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


# Gradients longer than this are shortened: a rare batch shall not throw the weights away.
_LONGEST_GRADIENT = 5.0


@dataclass
class State:
    """What a training is made of at any time."""

    net: nn.Module
    optimizers: list[torch.optim.Optimizer]
    epoch: int = 0
    history: list[dict[str, float]] = field(default_factory=list)

    def stored(self, identity: str) -> dict[str, Any]:
        """Returns everything to go on from, as tensors and plain values."""
        return {
            "identity": identity,
            "epoch": self.epoch,
            "history": self.history,
            "net": self.net.state_dict(),
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
        }

    def restore(self, stored: dict[str, Any]) -> None:
        """Takes up what was stored."""
        self.net.load_state_dict(stored["net"])
        for optimizer, kept in zip(self.optimizers, stored["optimizers"], strict=True):
            optimizer.load_state_dict(kept)
        self.epoch, self.history = stored["epoch"], stored["history"]


def make_state(net: nn.Module, params: TrainParams) -> State:
    """Returns the state at the start."""
    return State(net, make_optimizers(net, params))


def learning_rate(params: TrainParams, step: int, steps: int) -> float:
    """Returns the rate of a step of so many: a straight rise, then half a cosine down to ``lr_end``."""
    rise = params.warmup * steps
    if step < rise:
        return params.lr * min(1.0, (step + 1) / rise)  # a rise may end before a step does
    share = (step - rise) / max(1.0, steps - rise)
    return params.lr_end + 0.5 * (params.lr - params.lr_end) * (1 + math.cos(math.pi * share))


def fit(
    state: State,
    params: TrainParams,
    train: list[Sample],
    val: list[Sample],
    stride: int,
    place: TrainingProcess,
    identity: str,
    after_epoch: Callable[[dict[str, float]], None] = lambda row: None,
) -> None:
    """Trains from the state's epoch to the last; checkpoints go to ``params.out``.

    Args:
        state: Where to start; changed in place.
        params: How to train.
        train: Views to train on.
        val: Views to validate on.
        stride: Sides of pictures are padded to multiples of this.
        place: Of this process among others.
        identity: What the checkpoint must match to be taken up.
        after_epoch: Called on rank 0 with each new row of the history.

    Raises:
        ConfigError: The training diverged.
    """
    steps = steps_per_epoch(len(train), params.batch)
    model = place.wrapped(Padding(state.net, stride))
    label = f"epochs {state.epoch + 1} to {params.epochs}"
    # One count over all of them: what is left is the training's, not an epoch's.
    with Progress(label, (params.epochs - state.epoch) * steps) as progress:
        for epoch in range(state.epoch, params.epochs):
            loss = place.mean(_epoch(model, state, params, train, epoch, steps, place, progress))
            state.epoch = epoch + 1
            row = {
                "epoch": float(epoch + 1),
                "loss": loss,
                "lr": learning_rate(params, epoch * steps, params.epochs * steps),
            }
            is_last = state.epoch == params.epochs
            if place.rank == 0:
                if state.epoch % params.val_every == 0 or is_last:
                    row |= validation_iou(state.net, val, params.size, not params.crop, stride, place.device)
                state.history.append(row)
                if "mean_iou" in row:
                    save_checkpoint(state.stored(identity), Path(params.out).expanduser())
                after_epoch(row)


def _epoch(
    model: nn.Module,
    state: State,
    params: TrainParams,
    train: list[Sample],
    epoch: int,
    steps: int,
    place: TrainingProcess,
    progress: Progress,
) -> float:
    """Trains one epoch and returns the mean loss of this process."""
    model.train()
    total = 0.0
    for step, (images, truth) in enumerate(batches(train, params, epoch, 0, place.rank, place.ranks)):
        rate = learning_rate(params, epoch * steps + step, params.epochs * steps)
        set_rate(state.optimizers, rate / params.lr)
        images, truth = images.to(place.device), truth.to(place.device)
        if place.device.type == "cpu":
            images = images.contiguous(memory_format=torch.channels_last)
        with _precision(params.precision, place.device):
            outputs = model(images)
        loss = total_loss(outputs, truth, params.weighting)
        total += _finite(float(loss.detach()), epoch, step)
        model.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(state.net.parameters(), _LONGEST_GRADIENT)
        for optimizer in state.optimizers:
            optimizer.step()
        progress.advance()
    return total / steps


def _finite(loss: float, epoch: int, step: int) -> float:
    """Returns a loss that is a number: what is learnt from another one spoils all weights for good."""
    if not math.isfinite(loss):
        raise ConfigError(
            f"The loss is {loss} in step {step + 1} of epoch {epoch + 1}: the training has diverged.",
            "A smaller `schedule.lr` and `schedule.muon_lr`, in another `out=FOLDER`; "
            "the last checkpoint stays.",
        )
    return loss


def _precision(wanted: str, device: torch.device) -> AbstractContextManager[Any]:
    on_gpu = device.type == "cuda" and torch.cuda.is_bf16_supported()
    if wanted == "bfloat16" or (wanted == "auto" and on_gpu):
        mixed: AbstractContextManager[Any] = torch.autocast(device.type, dtype=torch.bfloat16)
        return mixed
    return nullcontext()
