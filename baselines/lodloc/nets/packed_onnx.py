"""An ONNX file made small, its sizes stated."""

from __future__ import annotations

from pathlib import Path

from lodbench.segmentation.nets.weights import halve_kernels
from lodbench.storage import write_bytes

# Of the input that the file states, pixels; it is run at any multiple of the stride.
_EXAMPLE_HEIGHT, _EXAMPLE_WIDTH = 128, 192


def pack_onnx(path: Path) -> None:
    """Stores kernels as 16 bits, each cast to 32 before it is used, and states the size of an example.

    It runs at other sizes than the one stated too: OpenCV 4.10 does not read joined features of free ones.
    """
    import onnx

    model = onnx.load(str(path), load_external_data=False)
    halve_kernels(model)
    graph = model.graph
    for value, shrink in ((graph.input[0], 1), (graph.output[0], 2)):
        sides = value.type.tensor_type.shape.dim[2:]
        for side, size in zip(sides, (_EXAMPLE_HEIGHT, _EXAMPLE_WIDTH), strict=True):
            side.dim_value = size // shrink
    onnx.checker.check_model(model)
    write_bytes(path, model.SerializeToString(deterministic=True))
