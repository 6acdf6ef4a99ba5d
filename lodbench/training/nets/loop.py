"""A training from start, or checkpoint, to weights: exact to the step, the same every time on a CPU."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call

from lodbench.errors import ConfigError
from lodbench.execution import Progress
from lodbench.extras import require
from lodbench.segmentation.nets.weights import Padding, load_weights, save_weights
from lodbench.segmentation.protocol import TrainableSegmenter
from lodbench.segmentation.torch_segmenter import require_memory
from lodbench.training.nets.batches import (
    TrainingProcess,
    against_rest,
    batch_shape,
    batches,
    joined,
    load_checkpoint,
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
        load_weights(net, path)
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
            inputs = (images.to(place.device) for images, _ in pictures)
            adapt_norms(Padding(net, segmenter.stride), inputs)
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
