"""One training from start, or checkpoint, to weights."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from pathlib import Path

import torch

from lodbench.extras import require
from lodbench.segmentation.nets.weights import save_weights
from lodbench.segmentation.nets.working import Padding
from lodbench.segmentation.trainable import TrainableSegmenter
from lodbench.training.nets.average import average_into
from lodbench.training.nets.batches import batch_shape, batches
from lodbench.training.nets.checkpoints import load_checkpoint
from lodbench.training.nets.distributed import joined
from lodbench.training.nets.loop import fit, make_state
from lodbench.training.nets.room import require_room
from lodbench.training.nets.validate import validation_iou
from lodbench.training.nets.warm_start import adapt_norms
from lodbench.training.samples import Sample
from lodbench.training.train_params import TrainParams

History = list[dict[str, float]]
# The mean of several trainings, for others to start from or to be averaged with.
AVERAGED_FILE = "averaged.safetensors"
# Batches that tell what the normalisations of given weights will meet.
_PICTURED_BATCHES = 8


def run_training(
    segmenter: TrainableSegmenter,
    params: TrainParams,
    train: list[Sample],
    val: list[Sample],
    identity: str,
    keep: Callable[[History], None],
    started_at: list[int],
) -> tuple[History, Path, dict[str, float]]:
    """Trains and returns the history, the weights' file, and the IoUs of the mean of several trainings.

    The last are empty where none is averaged: the weights are then those of the history's last row.

    Args:
        segmenter: Knows how to build its network and how to store its weights.
        params: How to train.
        train: Views to train on.
        val: Views to validate on.
        identity: Digest that a checkpoint must bear to be taken up.
        keep: Called with the history so far after each epoch, and at the end.
        started_at: Filled with the number of epochs that were there already.
    """
    out = Path(params.out).expanduser()
    _make_deterministic(params)
    with joined(params.device) as place:
        net = segmenter.build(params.init).to(place.device)
        if place.device.type == "cpu":
            net = net.to(memory_format=torch.channels_last)
        if place.device.type == "cpu":
            require_room(Padding(net, segmenter.stride), batch_shape(train, params))
        stored = load_checkpoint(out, identity) if params.resume else None
        if params.init and stored is None:
            pictures = islice(batches(train, params, 0, 0, 0, 1), _PICTURED_BATCHES)
            seen = (images.to(place.device) for images, _ in pictures)
            adapt_norms(Padding(net, segmenter.stride), seen)
        state = make_state(net, params)
        if stored is not None:
            state.restore(stored)
        started_at.append(state.epoch)
        state.history = state.history if place.rank == 0 else []
        board = _board(out) if params.tensorboard and place.rank == 0 else None

        def after_epoch(row: dict[str, float]) -> None:
            keep(state.history)
            if board is not None:
                for name, value in row.items():
                    board(name, value, int(row["epoch"]))

        fit(state, params, train, val, segmenter.stride, place, identity, after_epoch)
        averaged: dict[str, float] = {}
        if params.average:
            average_into(net, [Path(path).expanduser() for path in params.average])
            if place.rank == 0:  # the checkpoint keeps this training's own weights
                averaged = validation_iou(
                    net, val, params.size, not params.crop, segmenter.stride, place.device
                )
                save_weights(net.cpu(), out / AVERAGED_FILE)
        weights = segmenter.store(net.cpu().eval(), out) if place.rank == 0 else out
    return state.history, weights, averaged


def _make_deterministic(params: TrainParams) -> None:
    torch.manual_seed(params.seed)
    if params.threads is not None:
        torch.set_num_threads(params.threads)
    # On a GPU some operations have no deterministic form: a warning then, no fault.
    torch.use_deterministic_algorithms(True, warn_only=True)


def _board(out: Path) -> Callable[[str, float, int], None]:
    """Returns what logs a number for TensorBoard.

    Raises:
        ConfigError: TensorBoard is not installed.
    """
    require("tensorboard", "tensorboard", "tensorboard=true")
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(str(out / "tensorboard"))

    def log(name: str, value: float, epoch: int) -> None:
        writer.add_scalar(name, value, epoch)
        writer.flush()

    return log
