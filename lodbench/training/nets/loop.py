"""The training loop: exact to the step, resumable, the same numbers every time on a CPU."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn

from lodbench.errors import ConfigError
from lodbench.execution import Progress
from lodbench.segmentation.nets.working import Padding
from lodbench.training.nets.batches import batches, steps_per_epoch
from lodbench.training.nets.checkpoints import save_checkpoint
from lodbench.training.nets.distributed import Place
from lodbench.training.nets.losses import total_loss
from lodbench.training.nets.optimizers import make_optimizers, set_rate
from lodbench.training.nets.validate import validation_iou
from lodbench.training.samples import Sample
from lodbench.training.train_params import TrainParams

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
    place: Place,
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
    place: Place,
    progress: Progress,
) -> float:
    """Trains one epoch and returns the mean loss of this process.

    Raises:
        ConfigError: The loss is no number any more.
    """
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
    """Returns a loss that is a number: what is learnt from another one spoils all weights for good.

    Raises:
        ConfigError: It is none.
    """
    if not math.isfinite(loss):
        raise ConfigError(
            f"The loss is {loss} in step {step + 1} of epoch {epoch + 1}: the training has diverged.",
            "A smaller schedule.lr and schedule.muon_lr, in another out=FOLDER; the last checkpoint stays.",
        )
    return loss


def _precision(wanted: str, device: torch.device) -> AbstractContextManager[Any]:
    on_gpu = device.type == "cuda" and torch.cuda.is_bf16_supported()
    if wanted == "bfloat16" or (wanted == "auto" and on_gpu):
        mixed: AbstractContextManager[Any] = torch.autocast(device.type, dtype=torch.bfloat16)
        return mixed
    return nullcontext()
