"""Weights into networks: shapes compared first, nothing unpickled."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lodbench.errors import ConfigError
from lodbench.extras import require
from lodbench.storage import write_bytes

_OPSET = 13


class _FirstOutput(nn.Module):
    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, photos: torch.Tensor) -> torch.Tensor:
        first: torch.Tensor = self.net(photos)[0]
        return first


def write_onnx(net: nn.Module, path: Path, stride: int, half: bool = False, answer: str = "logits") -> None:
    """Writes a network that takes ``photo`` (1, 3, H, W), H and W free multiples of ``stride``.

    Args:
        net: The network; its first output is what is written.
        path: The file.
        stride: Least side of what the network takes, pixels.
        half: Whether weights are stored as 16 bit floats, half the bytes; it still works with 32.
        answer: What the file calls what is answered.

    Raises:
        ConfigError: The package onnx is not installed.
    """
    require("onnx", "torch", "writing ONNX")
    example = torch.zeros(1, 3, 4 * stride, 6 * stride)
    content = io.BytesIO()
    plain = _FirstOutput(net).eval().to(memory_format=torch.contiguous_format)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter tells of a successor that needs two more packages
        torch.onnx.export(
            plain,
            (example,),
            content,
            input_names=["photo"],
            output_names=[answer],
            dynamic_axes={"photo": {2: "height", 3: "width"}, answer: {2: "height", 3: "width"}},
            opset_version=_OPSET,
            dynamo=False,
        )
    write_bytes(path, _halved(content.getvalue()) if half else content.getvalue())


def _halved(content: bytes) -> bytes:
    import onnx

    model = onnx.load_from_string(content)
    halve_kernels(model)
    whole: bytes = model.SerializeToString(deterministic=True)
    return whole


def halve_kernels(model: Any) -> None:
    """Stores a model's kernels in 16 bits, each brought back to 32 before its first use; changed in place."""
    from onnx import TensorProto, helper, numpy_helper

    graph, casts, kept = model.graph, [], []
    for tensor in graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.ndim == 4 and values.dtype == np.float32:
            stored = f"{tensor.name}.half"
            casts.append(helper.make_node("Cast", [stored], [tensor.name], to=TensorProto.FLOAT))
            tensor = numpy_helper.from_array(values.astype(np.float16), stored)
        kept.append(tensor)
    nodes = [*casts, *graph.node]
    del graph.initializer[:], graph.node[:]
    graph.initializer.extend(kept)
    graph.node.extend(nodes)


Net = TypeVar("Net", bound=nn.Module)
_LAYERS = (nn.Conv2d, nn.BatchNorm2d)


def _load_onnx(net: Net, path: Path, stride: int) -> Net:
    """Returns a network with the weights of an ONNX file of its kind; in evaluation it answers the same.

    The export has folded normalisations into the convolutions before them. Such a kernel comes back with a
    length of one per output, and what that changes goes into the normalisation: the answer stays, and steps
    of a learning rate are of one size in all kernels.

    Args:
        net: Takes (B, 3, H, W).
        path: The file.
        stride: Least side of what the network takes, pixels.

    Raises:
        ConfigError: The package onnx is missing, or the file is of another network.
    """
    require("onnx", "torch", "training from an ONNX file")
    layers = _layers(net, stride)
    try:
        for kind, tensors in _stored(path):
            layer = next(layers)
            if kind == "Conv" and isinstance(layer, nn.Conv2d):
                kernel, *bias = tensors
                if bias and layer.bias is None:
                    _unfold(layer, next(layers), kernel, bias[0])
                else:
                    _fill([layer.weight, layer.bias], tensors)
            elif kind == "BatchNormalization" and isinstance(layer, nn.BatchNorm2d):
                _fill([layer.weight, layer.bias, layer.running_mean, layer.running_var], tensors)
            else:
                raise ValueError(f"{kind} where {type(layer).__name__} is wanted")
        if next(layers, None) is not None:
            raise ValueError("layers are missing")
    except (ValueError, StopIteration) as error:
        raise ConfigError(
            f"{path} does not fit the network: {error or 'layers too many'}.",
            "An ONNX file that lodbench train wrote for the same segmenter is wanted.",
        ) from error
    return net


def _layers(net: nn.Module, stride: int) -> Iterator[nn.Module]:
    """Yields convolutions and normalisations in the order in which they are called."""
    called: list[nn.Module] = []
    hooks = [
        module.register_forward_hook(lambda module, _inputs, _output: called.append(module))
        for module in net.modules()
        if isinstance(module, _LAYERS)
    ]
    with torch.no_grad():
        net.eval()(torch.zeros(1, 3, stride, stride))
    for hook in hooks:
        hook.remove()
    net.train()
    return iter(called)


def _stored(path: Path) -> Iterator[tuple[str, list[Tensor]]]:
    """Yields kind and weights of a file's convolutions and normalisations, in order."""
    import onnx
    from onnx import numpy_helper

    try:
        graph: Any = onnx.load(str(path), load_external_data=False).graph
        tensors = {t.name: torch.from_numpy(numpy_helper.to_array(t).copy()) for t in graph.initializer}
        for node in graph.node:  # weights stored in 16 bits
            if node.op_type == "Cast" and node.input[0] in tensors:
                tensors[node.output[0]] = tensors[node.input[0]].float()
    except Exception as error:
        raise ConfigError(
            f"{path} cannot be read as ONNX ({type(error).__name__}).",
            "One file with all of its weights is wanted, as lodbench train writes it.",
        ) from error
    for node in graph.node:
        if node.op_type in ("Conv", "BatchNormalization"):
            yield node.op_type, [tensors[name] for name in node.input[1:] if name in tensors]


@torch.no_grad()
def _unfold(conv: nn.Conv2d, norm: nn.Module, kernel: Tensor, bias: Tensor) -> None:
    """Gives a convolution and the normalisation after it what an export has folded into one."""
    if not isinstance(norm, nn.BatchNorm2d):
        raise ValueError("a convolution has a bias that the network knows nothing of")
    lengths = kernel.flatten(1).norm(dim=1).clamp_min(1e-12)
    _fill([conv.weight], [kernel / lengths[:, None, None, None]])
    mean, variance = torch.zeros_like(bias), torch.full_like(bias, 1 - norm.eps)
    _fill([norm.weight, norm.bias, norm.running_mean, norm.running_var], [lengths, bias, mean, variance])


@torch.no_grad()
def _fill(wanted: list[Tensor | None], stored: list[Tensor]) -> None:
    present = [tensor for tensor in wanted if tensor is not None]
    shapes = [[list(tensor.shape) for tensor in tensors] for tensors in (stored, present)]
    if shapes[0] != shapes[1]:
        raise ValueError(f"weights of {shapes[0]} instead of {shapes[1]}")
    for tensor, values in zip(present, stored, strict=True):
        tensor.copy_(values)


Weights = dict[str, Tensor]
_SHOWN = 3


def load_weights(
    net: Net, path: str | Path | None, renamed: Callable[[Weights], Weights] | None = None, stride: int = 32
) -> Net:
    """Returns a network with the weights of a file; as it is without one.

    Args:
        net: Changed in place.
        path: ONNX as ``lodbench train`` writes it, safetensors, or a torch file of tensors; None for none.
        renamed: Returns the tensors of the latter two under the network's names; None if they have them.
        stride: Least side of what the network takes, pixels.

    Raises:
        ConfigError: The file is missing or holds other weights.
    """
    if path is None:
        return net
    file = Path(path).expanduser()
    if file.suffix == ".onnx":
        return _load_onnx(net, file, stride)
    stored = read_weights(file)
    fill(net, stored if renamed is None else renamed(stored), str(path))
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
