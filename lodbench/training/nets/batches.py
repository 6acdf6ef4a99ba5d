"""Batches of samples, and checkpoints: the same for a seed, an epoch and a step, wherever a run goes on.

A checkpoint is everything that a training goes on from, whole or not at all; nothing is unpickled.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, distributed, nn

from lodbench.errors import ConfigError
from lodbench.segmentation.nets.weights import Padding, read_torch_file
from lodbench.storage import random_stream, write_bytes
from lodbench.training.augment import covered, flipped, other_appearance, random_crop, relit
from lodbench.training.samples import LEAST_SHARE, Sample, TrainParams

Floats = NDArray[np.float32]
# Batches made ahead of the one in use.
_AHEAD = 3
# Share of drawn views that get the ground of photos, and how much that is enlarged.
_COVERED = 0.35
_GROUND_SCALE = (0.7, 2.0)


def steps_per_epoch(count: int, batch: int) -> int:
    """Returns the steps of an epoch: whole batches only, but at least one."""
    return max(1, count // batch)


def batches(
    samples: list[Sample], params: TrainParams, epoch: int, first_step: int, rank: int, ranks: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yields pictures (B, 3, H, W) and masks (B, 1 or classes, H, W) of an epoch from a step on.

    Args:
        samples: All training views.
        params: Batch, size and augmentation.
        epoch: Names the order and the changes.
        first_step: Steps of this epoch done already.
        rank: Of this process, which sees every ``ranks``-th sample of each batch.
        ranks: Processes that share each batch.
    """
    order = random_stream(params.seed, "train", "order", epoch).permutation(len(samples))
    size = min(params.batch, len(samples))
    steps = range(first_step, steps_per_epoch(len(samples), params.batch))
    chosen = [order[step * size : (step + 1) * size][rank::ranks] for step in steps]
    grounds = [sample for sample in samples if sample.is_ground]
    with ThreadPoolExecutor(1) as pool:
        waiting = []
        for indices in chosen:
            mine = [samples[int(index)] for index in indices]
            waiting.append(pool.submit(_batch, mine, params, epoch, grounds))
            if len(waiting) > _AHEAD:
                yield waiting.pop(0).result()
        for made in waiting:
            yield made.result()


def batch_shape(samples: list[Sample], params: TrainParams) -> tuple[int, int, int, int]:
    """Returns (B, 3, H, W) of the pictures of a batch, by the first sample."""
    height, width = _changed(samples[0], params, 0, [])[0].shape[:2]
    return min(params.batch, len(samples)), 3, height, width


def _batch(
    samples: list[Sample], params: TrainParams, epoch: int, grounds: list[Sample]
) -> tuple[Tensor, Tensor]:
    pairs = [_changed(sample, params, epoch, grounds) for sample in samples]
    return as_tensors([photo for photo, _ in pairs], [mask for _, mask in pairs])


def _changed(sample: Sample, params: TrainParams, epoch: int, grounds: list[Sample]) -> tuple[Floats, Floats]:
    generator = random_stream(params.seed, "train", sample.key, epoch)
    traced = sample.working_scale is not None and bool(params.crop)
    photo, mask = sample.read(0 if traced else params.size, square=not params.crop)
    # Upside down, walls hang above their roofs: no camera sees that, and a small network has better to learn.
    axes = (1, 0) if params.augment == "flips" else (1,)
    photo, mask = flipped(photo, mask, generator, axes)
    if params.crop:
        low, high = ((sample.working_scale or 1.0) * end for end in params.scale)
        photo, mask = random_crop(photo, mask, params.crop, (low, high), generator)
    if params.augment == "strong":
        buildings = mask if mask.ndim == 2 else mask.sum(axis=2)
        if grounds and not (sample.is_ground or traced) and generator.random() < _COVERED:
            photo = covered(photo, buildings, _ground(grounds, photo.shape, generator), generator)
        return other_appearance(photo, buildings, generator), mask
    if params.augment == "full":
        return relit(photo, generator, params.one_band), mask
    return as_floats(photo), mask


def _ground(
    grounds: list[Sample], shape: tuple[int, ...], generator: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Returns pieces of two photos without buildings, of a view's shape: for the ground and for roofs."""
    crops = []
    for _ in range(2):
        photo, mask = grounds[int(generator.integers(len(grounds)))].read(0, square=False)
        photo, mask = flipped(photo, mask, generator, (1, 0))
        square, _ = random_crop(photo, mask, max(shape[:2]), _GROUND_SCALE, generator)
        crops.append(square[: shape[0], : shape[1]])
    return crops[0], crops[1]


def as_floats(photo: NDArray[np.uint8]) -> Floats:
    """Returns a picture of bytes in [0, 1]."""
    return photo.astype(np.float32) / np.float32(255)


def as_tensors(photos: list[Floats], masks: list[Floats]) -> tuple[Tensor, Tensor]:
    """Returns pictures (H, W, 3) and masks (H, W) as (B, 3, H, W) and (B, 1, H, W).

    Masks (H, W, classes) become (B, classes, H, W).
    """
    images = np.stack(photos).transpose(0, 3, 1, 2)
    truth = np.stack(masks)
    truth = truth[:, None] if truth.ndim == 3 else truth.transpose(0, 3, 1, 2)
    return (
        torch.from_numpy(np.ascontiguousarray(images)),
        torch.from_numpy(np.ascontiguousarray(truth)),
    )


def against_rest(logits: Tensor) -> Tensor:
    """Returns the logits of each class against all others, of (B, C, H, W); one alone is that already.

    Two are roofs and walls; the third class, all else, has the logit 0.
    """
    return logits if logits.shape[1] == 1 else logits - F.softplus(logits.flip(1))


@torch.no_grad()
def validation_iou(
    net: nn.Module,
    samples: list[Sample],
    size: int,
    square: bool,
    stride: int,
    device: torch.device,
    advance: Callable[[], None] = lambda: None,
) -> dict[str, float]:
    """Returns the mean IoU per view and that of all pixels pooled, over views with 5 % buildings or more.

    Where classes are learnt each that takes 5 % of a view counts as a view.

    A network is left in the mode, training or not, that it came in.
    """
    was_training = net.training
    net.eval()
    shared_counts, union_counts = [], []
    for sample in samples:
        photo, mask = sample.read(size, square)
        images, truth = as_tensors([as_floats(photo)], [mask])
        logits = against_rest(Padding(net, stride)(images.to(device))[0].float().cpu())
        for predicted, wanted in zip(logits[0] >= 0, truth[0] >= 0.5, strict=True):
            if wanted.float().mean() >= LEAST_SHARE:
                shared_counts.append(int((predicted & wanted).sum()))
                union_counts.append(int((predicted | wanted).sum()))
        advance()
    net.train(was_training)
    if not union_counts:
        return {"mean_iou": float("nan"), "pooled_iou": float("nan"), "views": 0}
    shared, union = np.array(shared_counts), np.array(union_counts)
    return {
        "mean_iou": float((shared / union).mean()),
        "pooled_iou": float(shared.sum() / union.sum()),
        "views": len(union),
    }


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
        stored = state["identity"]
    except Exception as error:
        raise ConfigError(
            f"{path} is no checkpoint of lodbench train.", "Name another `out=FOLDER`."
        ) from error
    if stored != identity:
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
