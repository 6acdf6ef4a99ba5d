"""Methods in another environment: a child process that answers over pipes, and what goes over them.

It may hang, die or write nonsense. What goes over the pipes is JSON, and arrays of numbers as they lie in
memory: nothing is unpickled. A message is the length of its head (8 bytes, least first), the head in JSON,
then the bytes of its arrays. The head holds the values, the arrays' types and shapes, and their checksum:
nothing that was cut off can be filled up by the next message. Of classes only those of ``CLASSES`` are
made, field by field.

The two ends take turns. A message is a dictionary whose ``number`` is, of the parent's, one more than of the
last, and of the child's, that of the message it answers.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, is_dataclass
from enum import Enum
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Query, Reference
from lodbench.errors import ConfigError, LodbenchError, QueryFault, RenderingError, WorkersGone
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
# Of what the child wrote to standard error, at most this much is reported.
_TAIL_BYTES = 4000
# Bytes read and written at a time.
_CHUNK = 1 << 16
# How often, and how long each time, to wait for the end of a child that closed its pipe: seconds.
_LAST_WAITS, _WAIT_S = 250, 0.02


class MalformedMessage(LodbenchError):
    """What came over a pipe is no message."""


def fault_message(fault: LodbenchError) -> dict[str, str]:
    """Returns what is sent of a fault: its words, its hint, and the class of ``FAULTS`` that it is of.

    A method's own fault of a query is one here, too: as another it would end the run.
    """
    kind = next((kind.__name__ for kind in type(fault).mro() if FAULTS.get(kind.__name__) is kind), "")
    return {"fault": fault.message.marked, "hint": fault.hint.marked, "kind": kind}


def fault_of(said: dict[str, Any]) -> LodbenchError:
    """Returns the fault of a message from ``fault_message``; of a malformed one, its text."""
    kind = FAULTS.get(str(said.get("kind")), LodbenchError)
    return kind(str(said["fault"]), str(said.get("hint", "")))


def numbered(message: Any, number: int) -> dict[str, Any]:
    """Returns a message that is the one due.

    Raises:
        MalformedMessage: It is no dictionary, or has another number.
    """
    if not isinstance(message, dict):
        raise MalformedMessage("a message is no word")
    message_number = message.get("number")
    if type(message_number) is not int or message_number != number:
        raise MalformedMessage(f"a message has the number {str(message_number)[:20]} where {number} was due")
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
        checksum = 0
        for array in arrays:
            checksum = zlib.crc32(array.data if array.size else b"", checksum)
        if checksum != wanted:
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


def drawn_bytes(kind: str, camera: Camera, views: int) -> int:
    """Returns the bytes of so many views of a kind of ``KINDS``, 0 for others."""
    if kind == "counts":
        return views * _COUNTS_BYTES
    if kind == "silhouettes":
        return views * camera.height * -(-camera.width // 64) * 8
    return views * camera.height * camera.width * _PIXEL_BYTES.get(kind, 0)


class RunnerFault(ConfigError):
    """``runner.python`` is no Python that can run the method."""


class ProcessFault(Exception):
    """The child died, took too long or wrote no message; its standard error is a note of this exception."""


class Child:
    """A process of another Python, asked one thing at a time; it and all it starts are one process group.

    Raises:
        RunnerFault: It cannot be started.
    """

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        # Messages that were sent, and the end of what the child wrote to standard error.
        self._number, self._errors = 0, b""
        try:
            self._process = subprocess.Popen(  # noqa: S603 - the Python that the user names
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env=environment,
                bufsize=0,
                process_group=0,
            )
        except OSError as error:
            raise RunnerFault(
                f"{command[0]} cannot be started: {error.strerror}.", "runner.python=PATH names a Python."
            ) from error
        streams = self._process.stdin, self._process.stdout, self._process.stderr
        self._in, self._out, self._err = (stream.fileno() for stream in streams if stream is not None)
        self._err_is_open = True
        for stream in (self._in, self._out, self._err):
            os.set_blocking(stream, False)

    def call(self, message: dict[str, Any], answer: Callable[[list[Any]], Any], timeout_s: float) -> Any:
        """Returns the child's last word to a message.

        A child whose messages have other numbers than they should, or that says something before it is asked
        (two processes write, where a method forked), is stopped: its answer would be to another message.

        Args:
            message: What it is to do.
            answer: Answers what it asks meanwhile; what it raises goes to the child.
            timeout_s: Longest time for it, with all that is asked back meanwhile.

        Raises:
            ProcessFault: There is no answer; the child has been stopped.
            WorkersGone: So it was said where it asked; the child has been stopped.
        """
        deadline = time.monotonic() + timeout_s
        try:
            self._send(message, deadline)
            while True:
                said = numbered(unpacked(lambda count: self._read(count, deadline)), self._number)
                if "ask" not in said:
                    return said
                try:
                    reply = {"answer": answer(list(said["ask"]))}
                except WorkersGone:
                    # The run ends, and no query fails: nothing to tell the child.
                    self.close()
                    raise
                except LodbenchError as fault:
                    reply = fault_message(fault)
                except Exception as error:  # it may ask with arguments of any kind
                    reply = fault_message(RenderingError(f"{type(error).__name__}: {error}"))
                self._send(reply, deadline)
        except (TimeoutError, EOFError, OSError, MalformedMessage) as error:
            raise self._fault(error, timeout_s) from None

    def close(self) -> None:
        """Ends the process and whatever it started."""
        # Before it is waited for: until then nobody else can have its number.
        if self._process.returncode is None:
            self._kill_group()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()

    def _send(self, message: dict[str, Any], deadline: float) -> None:
        if self._has_unrequested():
            raise MalformedMessage("bytes that nobody had requested")
        self._number += 1
        self._write(packed({"number": self._number, **message}), deadline)

    def _has_unrequested(self) -> bool:
        """Tells whether bytes wait that were not requested."""
        if not select.select([self._out], [], [], 0)[0]:
            return False
        if not os.read(self._out, 1):
            raise EOFError
        return True

    def _read(self, count: int, deadline: float) -> bytes:
        parts, missing = [], count
        while missing:
            self._wait([self._out], [], deadline)
            # Room is made for what came, not for what is said to come.
            part = os.read(self._out, min(missing, _CHUNK))
            if not part:
                raise EOFError
            parts.append(part)
            missing -= len(part)
        return b"".join(parts)

    def _write(self, content: bytes, deadline: float) -> None:
        view = memoryview(content)
        while view:
            self._wait([], [self._in], deadline)
            view = view[os.write(self._in, view[:_CHUNK]) :]

    def _wait(self, reading: list[int], writing: list[int], deadline: float) -> None:
        """Returns when one of the pipes is ready; meanwhile takes what comes on standard error."""
        while (left := deadline - time.monotonic()) > 0:
            errors = [self._err] if self._err_is_open else []
            ready, writable, _ = select.select([*reading, *errors], writing, [], left)
            if self._err in ready:
                self._take_errors()
            if writable or set(ready) & set(reading):
                return
        raise TimeoutError

    def _take_errors(self) -> None:
        """Takes what is there of the child's standard error and keeps the end: it may write any amount."""
        # Once around what a pipe holds: a child that never stops must not keep this from its deadline.
        for _ in range(16):
            try:
                part = os.read(self._err, _CHUNK)
            except BlockingIOError:
                return
            if not part:
                self._err_is_open = False
                return
            self._errors = (self._errors + part)[-_TAIL_BYTES:]

    def _fault(self, error: Exception, timeout_s: float) -> ProcessFault:
        """Stops the child; returns why it gave no answer."""
        if isinstance(error, TimeoutError):
            reason = f"the method's process gave no answer in {timeout_s:g} s and was stopped"
        elif isinstance(error, MalformedMessage):
            reason = f"the method's process was stopped, for {error.message}"
        else:
            reason = f"the method's process ended with exit code {self._exit_code()}"
        if self._err_is_open:
            self._take_errors()
        errors = self._errors.decode(errors="replace").strip()
        self.close()
        last = errors.splitlines()[-1].strip() if errors else ""
        fault = ProcessFault(f"{reason}: {last}" if last else reason)
        if errors:
            fault.add_note(f"Its standard error:\n{errors}")
        return fault

    def _exit_code(self) -> int | None:
        """Returns the code of a process that closed its pipe, or None where it does not end."""
        for _ in range(_LAST_WAITS):
            if self._err_is_open:
                self._take_errors()  # else it may wait for room, and not end
            if (code := self._ended_with()) is not None:
                return code
            time.sleep(_WAIT_S)
        return None

    def _ended_with(self) -> int | None:
        """Returns the code of the process if it has ended, without taking it off the list of processes."""
        if not hasattr(os, "waitid"):
            # macOS before Python 3.13: it is off the list then, so what it started ends at once.
            if self._process.poll() is not None:
                self._kill_group()
            return self._process.returncode
        ended = os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG)
        if ended is None:
            return None
        return ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status

    def _kill_group(self) -> None:
        # macOS answers "not permitted" for a group of processes that have all ended.
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
