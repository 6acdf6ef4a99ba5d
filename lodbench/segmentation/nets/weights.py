"""Weights into networks: shapes compared first, nothing unpickled."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lodbench.errors import ConfigError

Net = TypeVar("Net", bound=nn.Module)
Weights = dict[str, Tensor]
_SHOWN = 3


def load_own(net: Net, path: str | None) -> Net:
    """Returns a network with the weights of a file that ``lodbench train`` or ``save_weights`` wrote.

    Raises:
        ConfigError: The file is missing or holds other weights.
    """
    if path is not None:
        fill(net, read_weights(Path(path).expanduser()), path)
    return net


def read_weights(path: Path) -> Weights:
    """Returns the tensors of a safetensors or torch file by name; wrappers such as ``net`` are opened.

    Raises:
        ConfigError: The file is missing, or no such file.
    """
    if not path.is_file():
        raise ConfigError(f"There are no weights {path}.", "Check the path.")
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return dict(load_file(path))
        stored = read_torch_file(path)
    except Exception as error:
        raise ConfigError(
            f"{path} cannot be read as weights ({type(error).__name__}).",
            "safetensors, or a torch file of tensors alone; nothing else is unpickled.",
        ) from error
    for wrapper in ("net", "model", "state_dict"):
        if isinstance(stored, dict) and isinstance(stored.get(wrapper), dict):
            stored = stored[wrapper]
    if not isinstance(stored, dict) or not all(_is_complete(value) for value in stored.values()):
        raise ConfigError(f"{path} holds no weights by name.", "A torch file of a state_dict is wanted.")
    return {str(name).removeprefix("module."): value for name, value in stored.items()}


def _is_complete(value: Any) -> bool:
    """Returns whether something is a tensor of numbers, each written down: neither sparse nor without any."""
    return isinstance(value, Tensor) and value.layout is torch.strided and not value.is_meta


def read_torch_file(path: Path) -> Any:
    """Returns what a torch file holds, on the CPU: tensors and plain values, nothing else is unpickled.

    Raises:
        Exception: It is missing, damaged or holds something else; of which kind is up to torch.
    """
    with warnings.catch_warnings():
        # It warns of old pickles before it refuses them, and the fault says all.
        warnings.simplefilter("ignore", UserWarning)
        return torch.load(path, map_location="cpu", weights_only=True)


def fill(net: nn.Module, weights: Weights, source: str) -> None:
    """Puts weights into a network.

    Raises:
        ConfigError: Names, shapes or kinds of numbers differ, and the message counts them and shows the
            first of each; or some are NaN or infinite.
    """
    wanted = net.state_dict()
    missing = [name for name in wanted if name not in weights and not name.endswith("num_batches_tracked")]
    unknown = [name for name in weights if name not in wanted]
    misshapen = [
        f"{name} is {list(weights[name].shape)} instead of {list(value.shape)}"
        for name, value in wanted.items()
        if name in weights and weights[name].shape != value.shape
    ]
    whole = [name for name, value in wanted.items() if _is_whole(weights.get(name), value)]
    if missing or unknown or misshapen or whole:
        faults = [
            f"{len(names)} {kind}: {', '.join(names[:_SHOWN])}{', ...' if len(names) > _SHOWN else ''}"
            for kind, names in (
                ("missing", missing),
                ("unknown", unknown),
                ("of another shape", misshapen),
                ("of whole numbers", whole),
            )
            if names
        ]
        raise ConfigError(
            f"{source} does not fit the network: {'; '.join(faults)}.",
            "Weights of another network or another size of it?",
        )
    require_finite(weights, source)
    net.load_state_dict(weights, strict=False)


def _is_whole(given: Tensor | None, wanted: Tensor) -> bool:
    """Returns whether weights are whole numbers where others are wanted: quantised, without their scale."""
    return given is not None and wanted.is_floating_point() and not given.is_floating_point()


def require_finite(weights: Mapping[str, Tensor], source: str) -> None:
    """Makes sure that weights are numbers: what a network answers with others would blame the photos.

    Raises:
        ConfigError: Some are NaN or infinite.
    """
    for name, value in weights.items():
        # Of the smallest of numbers torch itself does not say.
        number = value.float() if value.is_floating_point() and value.itemsize == 1 else value
        if value.is_floating_point() and not torch.isfinite(number).all():
            raise ConfigError(
                f"{source} is damaged: {name} holds NaN or infinity.", "Fetch or train it anew."
            )


def save_weights(net: nn.Module, path: Path) -> None:
    """Writes a network's weights as safetensors, whole or not at all."""
    from safetensors.torch import save

    from lodbench.storage import write_bytes

    write_bytes(path, save({name: value.contiguous() for name, value in net.state_dict().items()}))


class Padding(nn.Module):
    """A network that takes pictures of any size: they are padded for it, and its answers cut back.

    Args:
        net: Takes (B, C, H, W) and returns a tuple of (B, 1, H, W).
        stride: What its H and W are multiples of.
    """

    def __init__(self, net: nn.Module, stride: int) -> None:
        super().__init__()
        self.net, self.stride = net, stride

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        """Returns the network's answers, (B, 1, H, W) each, to pictures (B, C, H, W)."""
        height, width = images.shape[-2:]
        return tuple(answer[..., :height, :width] for answer in self.net(_padded(images, self.stride)))


def _padded(images: Tensor, stride: int) -> Tensor:
    """Returns (B, C, H, W) with its last row and column repeated up to multiples of a stride."""
    below, right = (-side % stride for side in images.shape[-2:])
    return F.pad(images, (0, right, 0, below), mode="replicate") if below or right else images
