"""The training loop: the same numbers every time on as many threads, and taken up where it stopped."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import nn

from lodbench.segmentation.masks import read_photo
from lodbench.segmentation.nets.unets import STRIDE
from lodbench.segmentation.probability import padded_photo, resized_photo
from lodbench.storage import random_stream
from lodbench.training.nets.batches import load_checkpoint, save_checkpoint

from ..training_params import LodLocTraining
from ..training_views import TrainingView
from .examples import losses_of
from .net import Features, WireframeNet, start_from, unpacked

History = list[dict[str, float]]
_LONGEST_GRADIENT = 5.0
_WEIGHT_DECAY = 1e-3


class KeptFeatures:
    """The trunk's features of photos, made once and kept, at half precision, as far as there is room."""

    def __init__(self, net: WireframeNet, most: int) -> None:
        self._net, self._most = net, most
        # By file: views of two sets may be called alike.
        self._kept: dict[Path, Features] = {}

    def __call__(self, view: TrainingView) -> Features:
        """Returns the features of a view's photo, float32, with a batch of one."""
        kept = self._kept.get(view.photo)
        if kept is None:
            with torch.no_grad():
                made = self._net.features(_picture(view))
            # Rounded whether kept or not: what is learnt does not depend on what there was room for.
            kept = Features(made.quarter.half(), made.half.half())
            if len(self._kept) < self._most:
                self._kept[view.photo] = kept
        return Features(kept.quarter.float(), kept.half.float())


def _picture(view: TrainingView) -> torch.Tensor:
    photo = resized_photo(read_photo(view.photo), view.camera.width, view.camera.height)
    padded = padded_photo(photo, STRIDE).transpose(2, 0, 1)[None]
    return torch.from_numpy(np.ascontiguousarray(padded, dtype=np.float32) / np.float32(255))


def train(
    settings: LodLocTraining,
    views: list[TrainingView],
    held_out: list[TrainingView],
    identity: str,
    keep: Callable[[WireframeNet, History], None],
) -> History:
    """Trains the heads and returns the history: the losses of each epoch, on views of either kind.

    Args:
        settings: How.
        views: To train on.
        held_out: To validate on.
        identity: Digest that a checkpoint must bear to be taken up.
        keep: Called with the network and the history so far after each epoch.
    """
    torch.manual_seed(settings.seed)
    torch.set_num_threads(settings.threads)
    torch.use_deterministic_algorithms(True, warn_only=True)
    out = Path(settings.out).expanduser()
    net = start_from(settings.init).eval()
    heads = [*net.coarse_head.parameters(), *net.fine_head.parameters()]
    optimizer = torch.optim.AdamW(heads, lr=settings.lr, weight_decay=_WEIGHT_DECAY)
    history: History = []
    stored = load_checkpoint(out, identity) if settings.resume else None
    if stored is not None:
        net.load_state_dict(stored["net"])
        optimizer.load_state_dict(stored["optimizer"])
        history = stored["history"]
    features = KeptFeatures(net, settings.keep)
    steps = max(1, len(views) // settings.batch)
    for epoch in range(len(history), settings.epochs):
        row = {"epoch": float(epoch + 1), "lr": learning_rate(settings, epoch * steps, steps)}
        row |= _epoch(net, optimizer, features, settings, views, epoch)
        row |= {f"val {name}": value for name, value in _validated(net, features, settings, held_out).items()}
        history.append(row)
        # Before the checkpoint: an epoch that the next start takes as done has left its weights.
        keep(net, history)
        made = {"identity": identity, "history": history, "net": net.state_dict()}
        save_checkpoint(made | {"optimizer": optimizer.state_dict()}, out)
    return history


def learning_rate(settings: LodLocTraining, step: int, steps_per_epoch: int) -> float:
    """Returns the rate of a step: a short straight rise, then half a cosine to a hundredth."""
    total = settings.epochs * steps_per_epoch
    rise = max(1.0, 0.03 * total)
    if step < rise:
        return settings.lr * min(1.0, (step + 1) / rise)  # a rise may end between two steps
    share = (step - rise) / max(1.0, total - rise)
    return settings.lr * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * share)))


def _epoch(
    net: WireframeNet,
    optimizer: torch.optim.Optimizer,
    features: KeptFeatures,
    settings: LodLocTraining,
    views: list[TrainingView],
    epoch: int,
) -> dict[str, float]:
    order = random_stream(settings.seed, "lodloc", "order", epoch).permutation(len(views))
    size = min(settings.batch, len(views))
    steps = max(1, len(views) // settings.batch)
    sums: dict[str, float] = {}
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(settings, epoch * steps + step, steps)
        optimizer.zero_grad(set_to_none=True)
        for index in order[step * size : (step + 1) * size]:
            view = views[int(index)]
            draw = random_stream(settings.seed, "lodloc", "train", view.key, epoch)
            losses = losses_of(unpacked(net.heads(features(view))), view, settings, draw)
            total = torch.stack(list(losses.values())).sum() / size
            total.backward()
            _add(sums, losses, 1.0 / (size * steps))
        nn.utils.clip_grad_norm_([w for g in optimizer.param_groups for w in g["params"]], _LONGEST_GRADIENT)
        optimizer.step()
    return sums


def _validated(
    net: WireframeNet, features: KeptFeatures, settings: LodLocTraining, views: list[TrainingView]
) -> dict[str, float]:
    sums: dict[str, float] = {}
    for view in views:
        draw = random_stream(settings.seed, "lodloc", "validate", view.key)
        with torch.no_grad():
            losses = losses_of(unpacked(net.heads(features(view))), view, settings, draw)
        _add(sums, losses, 1.0 / len(views))
    return sums


def _add(sums: dict[str, float], losses: dict[str, torch.Tensor], share: float) -> None:
    for name, value in losses.items():
        sums[name] = sums.get(name, 0.0) + share * float(value.detach())
