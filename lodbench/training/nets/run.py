"""One training from start, or checkpoint, to weights."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.func import functional_call

from lodbench.extras import require
from lodbench.segmentation.nets.weights import Padding, fill, read_weights, save_weights
from lodbench.segmentation.protocol import TrainableSegmenter
from lodbench.segmentation.torch_segmenter import require_memory
from lodbench.training.nets.batches import batch_shape, batches, joined, load_checkpoint, validation_iou
from lodbench.training.nets.loop import fit, make_state
from lodbench.training.samples import Sample, TrainParams


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
    """Returns what logs a number for TensorBoard."""
    require("tensorboard", "tensorboard", "tensorboard=true")
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(str(out / "tensorboard"))

    def log(name: str, value: float, epoch: int) -> None:
        writer.add_scalar(name, value, epoch)
        writer.flush()

    return log
