"""What goes over the pipes: JSON, and arrays of numbers as they lie in memory; nothing is unpickled.

A message is the length of its head (8 bytes, least first), the head in JSON, then the bytes of its arrays.
The head holds the values, the arrays' types and shapes, and their checksum: nothing that was cut off can be
filled up by the next message. Of classes only those of ``CLASSES`` are made, field by field.

The two ends take turns. A message is a dictionary whose ``number`` is, of the parent's, one more than of the
last, and of the child's, that of the message it answers.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from enum import Enum
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Query, Reference
from lodbench.errors import ConfigError, LodbenchError, QueryFault, RenderingError
from lodbench.geometry import Camera, Pose
from lodbench.methods.protocol import Estimate
from lodbench.rendering import Instances, IouCounts, ViewEdges

CLASSES = {
    kind.__name__: kind
    for kind in (Camera, Estimate, Instances, IouCounts, Pose, Query, Reference, Scene, ViewEdges)
}
# Faults that are made again at the other end; others become the one they all are.
FAULTS = {kind.__name__: kind for kind in (ConfigError, QueryFault, RenderingError)}
# Numbers and truth values only: no objects, no text.
_KINDS = "biuf"
_MOST_HEAD, _MOST_ARRAYS = 1 << 28, 1 << 33
# Reads exactly so many bytes.
Read = Callable[[int], bytes]


class MalformedMessage(LodbenchError):
    """What came over a pipe is no message."""


def fault_told(fault: LodbenchError) -> dict[str, str]:
    """Returns what is sent of a fault: its words, its hint, and the class of ``FAULTS`` that it is of.

    A method's own fault of a query is one here, too: as another it would end the run.
    """
    kind = next((kind.__name__ for kind in type(fault).mro() if FAULTS.get(kind.__name__) is kind), "")
    return {"fault": fault.message.marked, "hint": fault.hint.marked, "kind": kind}


def fault_of(said: dict[str, Any]) -> LodbenchError:
    """Returns the fault of a message from ``fault_told``; of a malformed one, its text."""
    kind = FAULTS.get(str(said.get("kind")), LodbenchError)
    return kind(str(said["fault"]), str(said.get("hint", "")))


def numbered(message: Any, number: int) -> dict[str, Any]:
    """Returns a message that is the one due.

    Raises:
        MalformedMessage: It is no dictionary, or has another number.
    """
    if not isinstance(message, dict):
        raise MalformedMessage("a message is no word")
    found = message.get("number")
    if type(found) is not int or found != number:
        raise MalformedMessage(f"a message has the number {str(found)[:20]} where {number} was due")
    return message


def packed(message: Any) -> bytes:
    """Returns a message as bytes: plain values, tuples, arrays, paths, and objects of ``CLASSES``.

    Functions are left out: they become None.

    Raises:
        MalformedMessage: It holds something else.
    """
    arrays: list[NDArray[Any]] = []
    tree = _plain(message, arrays)
    kinds = [[array.dtype.str, list(array.shape)] for array in arrays]
    body = b"".join(array.tobytes() for array in arrays)
    head = json.dumps([tree, kinds, zlib.crc32(body)]).encode()
    return b"".join([len(head).to_bytes(8, "little"), head, body])


def unpacked(read: Read) -> Any:
    """Returns the next message.

    Raises:
        MalformedMessage: It is none, or too large.
    """
    length = int.from_bytes(read(8), "little")
    if length > _MOST_HEAD:
        raise MalformedMessage(f"the head of a message has {length} bytes")
    try:
        tree, kinds, wanted = json.loads(read(length))
        arrays = [_array(read, np.dtype(kind), [int(side) for side in shape]) for kind, shape in kinds]
        found = 0
        for array in arrays:
            found = zlib.crc32(array.data if array.size else b"", found)
        if found != wanted:
            raise MalformedMessage("a message whose arrays have another checksum")
        return _whole(tree, arrays)
    except (MalformedMessage, OSError, EOFError):
        raise
    except Exception as error:  # whatever the other side wrote, it is no message
        raise MalformedMessage(f"a message cannot be read: {type(error).__name__}") from error


def _array(read: Read, dtype: np.dtype[Any], shape: list[int]) -> NDArray[Any]:
    if dtype.kind not in _KINDS or dtype.fields is not None or min(shape, default=0) < 0:
        raise MalformedMessage(f"an array of {dtype} and shape {shape}")
    size = prod(shape) * dtype.itemsize
    if size > _MOST_ARRAYS:
        raise MalformedMessage(f"an array of {size} bytes")
    return np.frombuffer(bytearray(read(size)), dtype).reshape(shape)


def _plain(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """Returns a value as JSON values; its arrays go to a list."""
    if isinstance(value, np.generic | Enum):
        value = value.item() if isinstance(value, np.generic) else value.value
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list):
        return [_plain(item, arrays) for item in value]
    if isinstance(value, np.ndarray) and value.dtype.kind in _KINDS:
        arrays.append(value)
        return {"array": len(arrays) - 1}
    if isinstance(value, tuple | set | frozenset):
        return {"tuple": [_plain(item, arrays) for item in value]}
    if isinstance(value, dict):
        return {"dict": [[str(key), _plain(item, arrays)] for key, item in value.items()]}
    if isinstance(value, Path):
        return {"path": str(value)}
    if is_dataclass(value) and type(value).__name__ in CLASSES:
        held = {field.name: getattr(value, field.name) for field in fields(value)}
        return {"class": type(value).__name__, "fields": {k: _plain(v, arrays) for k, v in held.items()}}
    if callable(value):
        return None
    raise MalformedMessage(f"{type(value).__name__} does not go over a pipe")


def _whole(tree: Any, arrays: list[NDArray[Any]]) -> Any:
    """Returns the value of what ``_plain`` made."""
    if isinstance(tree, list):
        return [_whole(item, arrays) for item in tree]
    if not isinstance(tree, dict):
        return tree
    if "class" in tree:
        return CLASSES[tree["class"]](**{k: _whole(v, arrays) for k, v in tree["fields"].items()})
    ((kind, held),) = tree.items()
    if kind == "array":
        return arrays[held]
    if kind == "tuple":
        return tuple(_whole(item, arrays) for item in held)
    if kind == "path":
        return Path(held)
    if kind != "dict":
        raise MalformedMessage(f"a message holds {kind!r}")
    return {key: _whole(item, arrays) for key, item in held}


# Bytes of one pixel. Edges and single buildings take what there is to see, seldom as much as this.
_PIXEL_BYTES = {
    "render": 1,
    "instances": 1,
    "buildings": 4,
    "depth": 4,
    "surface_depth": 4,
    "normals": 12,
    "colour": 3,
    "edges": 4,
}
# Of a pose's counts: two integers.
_COUNTS_BYTES = 16
KINDS = frozenset({"silhouettes", "counts", *_PIXEL_BYTES})


def drawn_bytes(kind: str, camera: Camera, views: int) -> int:
    """Returns the bytes of so many views of a kind of ``KINDS``, 0 for others."""
    if kind == "counts":
        return views * _COUNTS_BYTES
    if kind == "silhouettes":
        return views * camera.height * -(-camera.width // 64) * 8
    return views * camera.height * camera.width * _PIXEL_BYTES.get(kind, 0)
