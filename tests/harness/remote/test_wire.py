"""Messages come back as they went, and nonsense is told."""

import io
import json
from pathlib import Path

import numpy as np
import pytest

from lodbench.errors import RenderingError
from lodbench.geometry import Camera, Pose
from lodbench.harness.remote.child import Pipe
from lodbench.harness.remote.wire import MalformedMessage, packed, unpacked

pytestmark = pytest.mark.attack


def reader(content: bytes):
    parts = iter([content])
    rest = [next(parts)]

    def read(count: int) -> bytes:
        found, rest[0] = rest[0][:count], rest[0][count:]
        if len(found) < count:
            raise EOFError
        return found

    return read


def test_messages_come_back_as_they_went():
    generator = np.random.default_rng(1)
    values = [
        {"a": 1, "b": None, "dict": {"tuple": "x"}},
        (1.5, float("inf"), True, "ö"),
        generator.normal(size=(2, 3)).astype(np.float32),
        np.zeros((0, 4), bool),
        np.array(7, dtype=np.uint64),
        Path("/a b/c"),
        Camera(4, 3, 2.0, 2.0, 2.0, 1.5, (0.1, 0.0, 0.0, 0.0)),
        np.float64(0.1),
    ]
    found = unpacked(reader(packed(values)))
    for value, back in zip(values, found, strict=True):
        if isinstance(value, np.ndarray):
            assert (back.dtype, back.shape) == (value.dtype, value.shape)
            np.testing.assert_array_equal(back, value)
            assert back.flags.writeable or back.size == 0
        else:
            assert back == value
    pose = Pose.from_center(np.eye(3), (1.0, 2.0, 3.0))
    assert unpacked(reader(packed(pose))).cam_from_world.tobytes() == pose.cam_from_world.tobytes()
    with pytest.raises(MalformedMessage, match="object"):
        packed([object()])


LENS = {"width": 4, "height": 3, "fx": 2.0, "fy": 2.0, "cx": 2.0, "cy": 1.5}


@pytest.mark.parametrize(
    "head",
    [
        [{"array": 0}, [["|O", [1]]], 0],
        [{"array": 0}, [["<f8", [-1]]], 0],
        [{"array": 0}, [["<f8", [1 << 40]]], 0],
        [{"array": 3}, [], 0],
        [{"class": "Popen", "fields": {}}, [], 0],
        [{"class": "Camera", "fields": {"system": 1}}, [], 0],
        [{"class": "Camera", "fields": {**LENS, "distortion": {"tuple": [1.0]}}}, [], 0],
        [{"reduce": 1}, [], 0],
        [{"a": 1, "b": 2}, [], 0],
        [None, [["|u1", [0]]], 1],
        [None, []],
        {"no": "list"},
        7,
    ],
)
def test_nonsense_is_told_and_makes_nothing(head):
    head = json.dumps(head).encode()
    with pytest.raises((MalformedMessage, EOFError)):
        unpacked(reader(len(head).to_bytes(8, "little") + head))
    deep = b"[" * 100_000
    with pytest.raises(MalformedMessage):
        unpacked(reader(len(deep).to_bytes(8, "little") + deep))


def test_a_hint_reaches_who_asked():
    fault = io.BytesIO(
        packed({"number": 1, "fault": "no such lens", "hint": "undo it", "kind": "RenderingError"})
    )
    with pytest.raises(RenderingError, match="no such lens") as caught:
        Pipe(fault, io.BytesIO()).ask("draw")
    assert caught.value.hint == "undo it"
