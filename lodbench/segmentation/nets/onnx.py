"""Networks as ONNX files that OpenCV reads: the same weights give the same bytes; and back."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
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


def load_onnx(net: Net, path: Path, stride: int) -> Net:
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
    """Yields kind and weights of a file's convolutions and normalisations, in order.

    Raises:
        ConfigError: It is no ONNX file.
    """
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
def _fill(wanted: list[Tensor | None], found: list[Tensor]) -> None:
    present = [tensor for tensor in wanted if tensor is not None]
    shapes = [[list(tensor.shape) for tensor in tensors] for tensors in (found, present)]
    if shapes[0] != shapes[1]:
        raise ValueError(f"weights of {shapes[0]} instead of {shapes[1]}")
    for tensor, values in zip(present, found, strict=True):
        tensor.copy_(values)
