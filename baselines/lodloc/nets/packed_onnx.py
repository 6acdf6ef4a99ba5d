"""An ONNX file made small, and readable by every OpenCV that lodbench runs with."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lodbench.storage import write_bytes

# Of the input that the file states, pixels; it is run at any multiple of the stride.
_EXAMPLE_HEIGHT, _EXAMPLE_WIDTH = 128, 192


def pack_onnx(path: Path) -> None:
    """Stores kernels as 16 bits, each cast to 32 before it is used, and states the size of an example.

    OpenCV 4.10 does not read joined features of free sizes, and takes other sizes than the one stated.
    """
    import onnx
    from onnx import helper, numpy_helper

    model = onnx.load(str(path), load_external_data=False)
    graph, casts, kept = model.graph, [], []
    for tensor in graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.ndim == 4:
            stored = f"{tensor.name}.half"
            casts.append(helper.make_node("Cast", [stored], [tensor.name], to=onnx.TensorProto.FLOAT))
            tensor = numpy_helper.from_array(values.astype(np.float16), stored)
        kept.append(tensor)
    nodes = [*casts, *graph.node]
    del graph.initializer[:], graph.node[:]
    graph.initializer.extend(kept)
    graph.node.extend(nodes)
    for value, shrink in ((graph.input[0], 1), (graph.output[0], 2)):
        sides = value.type.tensor_type.shape.dim[2:]
        for side, size in zip(sides, (_EXAMPLE_HEIGHT, _EXAMPLE_WIDTH), strict=True):
            side.dim_value = size // shrink
    onnx.checker.check_model(model)
    write_bytes(path, model.SerializeToString(deterministic=True))
