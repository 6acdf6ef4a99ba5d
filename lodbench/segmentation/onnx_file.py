"""Networks in ONNX files, run by OpenCV: no torch, nothing unpickled, no other file opened.

What must hold of an ONNX file before a reader in C++ sees it: no other files, shapes that can be. The file
is walked as protobuf (https://protobuf.dev/programming-guides/encoding) with the field numbers of
onnx.proto 1.17; nothing is built from it.
"""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.errors import ConfigError
from lodbench.photos.pictures import opencv_silenced
from lodbench.storage.digest import read_content

# Of a message: (number, its kind) of the fields looked at. Graphs stand in attributes, tensors in both.
_INSIDE = {
    "model": {7: "graph", 25: "function"},
    "graph": {1: "node", 5: "tensor", 11: "value", 12: "value", 13: "value", 15: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "value": {2: "type"},
    "type": {1: "tensor_type"},
    "tensor_type": {2: "shape"},
    "shape": {1: "dimension"},
}
# What networks of convolutions and of attention are made of. OpenCV's reader dies of names it does not know.
_OPERATORS = frozenset(
    b"""Abs Add And ArgMax AveragePool BatchNormalization Cast Ceil Clip Concat Constant ConstantOfShape Conv
    ConvTranspose Cos DepthToSpace Div Dropout Einsum Elu Equal Erf Exp Expand Flatten Floor Gather
    GatherElements GatherND Gelu Gemm GlobalAveragePool GlobalMaxPool Greater GreaterOrEqual
    GroupNormalization HardSigmoid HardSwish Identity If InstanceNormalization LayerNormalization
    LeakyRelu Less LessOrEqual Log LogSoftmax MatMul Max MaxPool Min Mish Mul Neg Not Or PRelu Pad Pow
    QuickGelu Range Reciprocal ReduceL2 ReduceMax ReduceMean ReduceMin ReduceSum Relu Reshape Resize
    Round ScatterND Selu Shape Sigmoid Sin Size Slice Softmax Softplus SpaceToDepth Split Sqrt Squeeze
    Sub Sum Tanh Tile TopK Transpose Unsqueeze Upsample Where""".split()
)
_NODE_OPERATOR, _NODE_DOMAIN = 4, 7
_MAX_DEPTH = 32
_MAX_MESSAGES = 1_000_000
# Of one message: a network of 100,000 nodes is none that runs here.
_MAX_FIELDS = 1_000_000
_MAX_RANK = 8
_MAX_DIMENSION = 1 << 24
_MAX_ELEMENTS = 1 << 30
# TensorProto: bytes of an element by data type; others, such as texts, hold no weights.
_ITEM_BYTES = {1: 4, 2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 8, 9: 1, 10: 2, 11: 8, 12: 4, 13: 8, 16: 2}
_DIMS, _DATA_TYPE, _RAW_DATA, _EXTERNAL_DATA, _DATA_LOCATION = 1, 2, 9, 13, 14
# The fields that hold a tensor's numbers one by one, with the bytes of each where packed; 0: of any length.
_TYPED_DATA = {4: 4, 5: 0, 7: 0, 10: 8, 11: 0}
# Attributes by which a layer divides, or allocates: from 1 to so much, and from minus to plus so much.
_SIZES = {b"kernel_shape": 1, b"strides": 1, b"dilations": 1, b"group": 1, b"pads": -(1 << 16)}
_MAX_SIZE = 1 << 16
_ATTRIBUTE_NAME, _ATTRIBUTE_INT, _ATTRIBUTE_INTS = 1, 3, 8
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5

Field = tuple[int, int, int, int]


def onnx_fault(content: bytes) -> str:
    """Returns what is wrong with the bytes of an ONNX file, or ""."""
    try:
        _check_all(content)
    except (ValueError, IndexError) as error:
        return str(error) or "it is cut short"
    return ""


def _check_all(content: bytes) -> None:
    """Walks every message that can hold a tensor, a shape or a name of another file."""
    waiting = [("model", 0, len(content), 0)]
    met, graphs = 0, 0
    while waiting:
        kind, first, last, depth = waiting.pop()
        met += 1
        graphs += kind == "graph"
        if depth > _MAX_DEPTH or met > _MAX_MESSAGES:
            raise ValueError("it is nested too deeply" if depth > _MAX_DEPTH else "it has too many parts")
        fields = list(islice(_fields(content, first, last), _MAX_FIELDS + 1))
        if len(fields) > _MAX_FIELDS:
            raise ValueError("it has too many parts")
        if kind == "tensor":
            _check_tensor(content, fields)
        elif kind == "node":
            _check_node(content, fields)
        elif kind == "attribute":
            _check_attribute(content, fields)
        elif kind == "dimension":
            _check_dimensions([value for number, wire, value, _ in fields if (number, wire) == (1, _VARINT)])
        inside = _INSIDE.get(kind, {})
        waiting += [
            (inside[number], start, end, depth + 1)
            for number, wire, start, end in fields
            if wire == _BYTES and number in inside
        ]
    if not graphs:
        raise ValueError("it holds no graph")


def _check_node(content: bytes, fields: list[Field]) -> None:
    words = {number: content[first:last] for number, wire, first, last in fields if wire == _BYTES}
    operator, domain = words.get(_NODE_OPERATOR, b""), words.get(_NODE_DOMAIN, b"")
    if operator not in _OPERATORS or domain not in (b"", b"ai.onnx"):
        raise ValueError(f"it asks for {ascii((domain + b' ' + operator).strip()[:40])[1:]}")


def _check_attribute(content: bytes, fields: list[Field]) -> None:
    names = [content[first:last] for number, wire, first, last in fields if number == _ATTRIBUTE_NAME]
    least = _SIZES.get(names[-1]) if names else None
    if least is None:
        return
    values = _numbers(content, fields, _ATTRIBUTE_INT) + _numbers(content, fields, _ATTRIBUTE_INTS)
    for value in map(_signed, values):
        if not least <= value <= _MAX_SIZE:
            raise ValueError(f"{names[-1].decode()} is {value}")


def _check_tensor(content: bytes, fields: list[Field]) -> None:
    if any(n == _EXTERNAL_DATA or (n == _DATA_LOCATION and value) for n, _, value, _ in fields):
        raise ValueError("its weights lie in another file")
    dims = _numbers(content, fields, _DIMS, _MAX_RANK)
    _check_dimensions(dims)
    count = math.prod(dims)
    if count > _MAX_ELEMENTS:
        raise ValueError(f"a tensor has {count} elements")
    data_type = next((value for number, _, value, _ in reversed(fields) if number == _DATA_TYPE), -1)
    raw_bytes = next((end - first for number, _, first, end in reversed(fields) if number == _RAW_DATA), -1)
    if raw_bytes >= 0 and data_type in _ITEM_BYTES and raw_bytes != count * _ITEM_BYTES[data_type]:
        raise ValueError(f"a tensor of shape {dims} has {raw_bytes} bytes")
    if raw_bytes < 0 and data_type in _ITEM_BYTES:
        stored = sum(_count(content, field) for field in fields if field[0] in _TYPED_DATA)
        if stored != count:
            raise ValueError(f"a tensor of shape {dims} has {stored} numbers")


def _count(content: bytes, field: Field) -> int:
    """Returns how many numbers a field of numbers holds, packed or alone."""
    number, wire, first, last = field
    if wire != _BYTES:
        return 1
    if width := _TYPED_DATA[number]:
        return (last - first) // width
    # The last byte of each number, and only that, is below 128.
    return int(np.count_nonzero(np.frombuffer(content, np.uint8, last - first, first) < 128))


def _numbers(content: bytes, fields: list[Field], wanted: int, most: int = 64) -> list[int]:
    """Returns the whole numbers of a repeated field, packed or one by one."""
    integers: list[int] = []
    for number, wire, value, end in fields:
        if number == wanted and wire == _BYTES:
            integers += _packed(content, value, end, most)
        elif number == wanted and wire == _VARINT:
            integers.append(value)
        if len(integers) > most:
            raise ValueError("a shape has too many dimensions")
    return integers


def _check_dimensions(dims: list[int]) -> None:
    for size in dims:
        if size > _MAX_DIMENSION:
            raise ValueError(f"a dimension is {_signed(size)}")


def _signed(value: int) -> int:
    return value if value < 1 << 63 else value - (1 << 64)


def _fields(content: bytes, first: int, last: int) -> Iterator[Field]:
    """Yields number, wire type, and value (of a number) or first and last place (of bytes) of each field."""
    place = first
    while place < last:
        key, place = _varint(content, place, last)
        number, wire = key >> 3, key & 7
        if wire == _VARINT:
            value, place = _varint(content, place, last)
            yield number, wire, value, place
        elif wire == _BYTES:
            size, place = _varint(content, place, last)
            if size > last - place:
                raise ValueError("it is cut short")
            yield number, wire, place, place + size
            place += size
        elif wire in (_FIXED64, _FIXED32):
            place += 8 if wire == _FIXED64 else 4
            if place > last:
                raise ValueError("it is cut short")
        else:
            raise ValueError("it is no protobuf")


def _packed(content: bytes, first: int, last: int, most: int) -> list[int]:
    """Returns whole numbers that stand side by side, and no more than one too many."""
    values: list[int] = []
    while first < last and len(values) <= most:
        value, first = _varint(content, first, last)
        values.append(value)
    return values


def _varint(content: bytes, place: int, last: int) -> tuple[int, int]:
    """Returns an unsigned number of up to 64 bits and where the next field begins."""
    value = shift = 0
    while shift < 70:
        if place >= last:
            raise ValueError("it is cut short")
        byte = content[place]
        value |= (byte & 127) << shift
        place, shift = place + 1, shift + 7
        if byte < 128:
            return value & ((1 << 64) - 1), place
    raise ValueError("it is no protobuf")


# The largest network that is run here has 0.3 GB.
_MAX_BYTES = 2 * 10**9
# A reader that takes longer, seconds, will not end.
_PROBE_S = 120.0
# Beyond what the file itself takes: importing OpenCV maps 1.5 GB.
_PROBE_BYTES = 8 << 30
_PROBE = """
import sys, cv2, numpy
content = sys.stdin.buffer.read()
try:
    import resource
    most = resource.getrlimit(resource.RLIMIT_AS)[1]
    wanted = int(sys.argv[1]) + 4 * len(content)
    wanted = wanted if most == resource.RLIM_INFINITY else min(wanted, most)
    resource.setrlimit(resource.RLIMIT_AS, (wanted, most))
except ImportError:
    pass
try:
    network = cv2.dnn.readNetFromONNX(numpy.frombuffer(content, numpy.uint8))
    network.setInput(numpy.zeros((1, 3, 64, 64), numpy.float32))
    network.forward()
except MemoryError:
    sys.exit(4)
except cv2.error as error:
    sys.exit(4 if error.code == cv2.Error.StsNoMem else 3)
"""


def read_onnx(path: Path, hint: str, is_ours: bool = False, digest: str | None = None) -> Any:
    """Returns OpenCV's network of a file.

    OpenCV's reader dies of some damage that ``onnx_fault`` does not see (ADR 0009, point 2): a file that is
    not ours is read, and run on a small picture, in a process of its own first.

    Args:
        path: The file; its name may hold what OpenCV's own reader cannot open.
        hint: Where to get a proper one.
        is_ours: It came with the package: believed.
        digest: SHA-256 that answers are kept under; None for any.

    Raises:
        InputChanged: The file is another than that of the digest.
        ConfigError: It cannot be read, holds what a network in one file never does, or nothing that OpenCV
            can run.
    """
    import cv2

    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConfigError(f"{path} has {path.stat().st_size / 1e9:.1f} GB, too many for a network.", hint)
        content = read_content(path, digest)
        fault = "" if is_ours else onnx_fault(content) or _probed(content)
        if fault:
            raise ConfigError(f"{path} is not a safe ONNX network: {fault}.", hint)
        with opencv_silenced():
            return cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8))
    except (cv2.error, OSError) as error:
        raise ConfigError(f"{path} is not an ONNX network that OpenCV can read.", hint) from error


def _probed(content: bytes) -> str:
    """Returns how OpenCV's reader ends in a process of its own, unless with an answer or an error."""
    command = [sys.executable, "-I", "-c", _PROBE, str(_PROBE_BYTES)]
    try:
        done = subprocess.run(command, input=content, capture_output=True, timeout=_PROBE_S)  # noqa: S603
    except subprocess.TimeoutExpired:
        return "OpenCV's reader does not end"
    if done.returncode == 4:
        return "it takes too much memory"
    return "" if done.returncode in (0, 3) else "OpenCV's reader breaks down"
