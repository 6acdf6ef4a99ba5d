"""A network as an ONNX file that OpenCV reads; the same weights give the same bytes."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import torch
from torch import nn

from lodbench.segmentation.extras import require
from lodbench.storage import write_bytes

_OPSET = 13


class _FirstOutput(nn.Module):
    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, photos: torch.Tensor) -> torch.Tensor:
        first: torch.Tensor = self.net(photos)[0]
        return first


def write_onnx(net: nn.Module, path: Path, stride: int) -> None:
    """Writes a network that takes ``photo`` (1, 3, H, W), H and W free multiples of ``stride``.

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
            output_names=["logits"],
            dynamic_axes={"photo": {2: "height", 3: "width"}, "logits": {2: "height", 3: "width"}},
            opset_version=_OPSET,
            dynamo=False,
        )
    write_bytes(path, content.getvalue())
