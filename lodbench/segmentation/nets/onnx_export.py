"""A network as an ONNX file that OpenCV reads; the same weights give the same bytes."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

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
