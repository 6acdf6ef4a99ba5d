"""The other end: a method in its own environment. `PYTHON -m lodbench.harness.remote.child`, by pipes only.

Its standard output is the pipe; what a method prints goes to standard error.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields, replace
from functools import cached_property, partial
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Query, Reference
from lodbench.errors import LodbenchError
from lodbench.execution.processes import single_threaded_blas
from lodbench.geometry import Camera, Pose
from lodbench.harness.remote import process
from lodbench.harness.runs.inputs import code_digest, words_in
from lodbench.methods import protocol
from lodbench.methods.localize import weight_files
from lodbench.methods.registry import configure_method
from lodbench.rendering import Fit, IouCounts

Floats = NDArray[np.float64]
# What is requested at a time.
_PORTION_BYTES = 1 << 26


class Pipe:
    """This process's end: asks the other end, and is asked."""

    def __init__(self, source: BinaryIO, target: BinaryIO) -> None:
        self._source, self._target = source, target
        self._number = 0

    def send(self, message: dict[str, Any]) -> None:
        """Sends a message, with the number of the one it answers."""
        self._target.write(process.packed({"number": self._number, **message}))
        self._target.flush()

    def receive(self) -> dict[str, Any]:
        """Returns the next message; ends the process where there is none, or not the one due."""

        def read(count: int) -> bytes:
            chunk = self._source.read(count)
            if len(chunk) < count:
                # Who asked is gone, perhaps without a word: nothing that a method started here stays.
                if os.getpgrp() == os.getpid():
                    os.killpg(0, signal.SIGKILL)
                raise SystemExit(0)
            return chunk

        self._number += 1
        try:
            return process.numbered(process.unpacked(read), self._number)
        except process.MalformedMessage as error:
            raise SystemExit(error.message) from error

    def ask(self, *words: Any) -> Any:
        """Returns the other end's answer; raises what it says was raised."""
        self.send({"ask": list(words)})
        answer = self.receive()
        if "fault" in answer:
            raise process.fault_of(answer)
        return answer["answer"]


class RemoteUsage:
    """Counts, at the other end, the poses that a method says it laid out without drawing."""

    def __init__(self, pipe: Pipe) -> None:
        self._pipe = pipe

    def add(self, kind: str, poses: int) -> None:
        """Counts so many poses."""
        self._pipe.ask("count", kind, poses)


class RemoteMap:
    """The map as a method sees it: drawn, and counted, at the other end."""

    def __init__(self, pipe: Pipe, about: dict[str, Any]) -> None:
        self._pipe = pipe
        self.usage = RemoteUsage(pipe)
        self.name, self.threads, self.is_textured = about["name"], about["threads"], about["is_textured"]

    @cached_property
    def scene(self) -> Scene:
        """Returns the city, sent over when it is first requested."""
        return cast("Scene", self._pipe.ask("scene"))

    def render(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the silhouette from one pose."""
        return cast("NDArray[np.bool_]", self._pipe.ask("draw", "render", {}, camera, pose))

    def __getattr__(self, kind: str) -> Callable[..., Any]:
        """Returns what draws a kind of view: ``silhouettes``, ``depth`` and so on."""
        if kind.startswith("_"):
            raise AttributeError(kind)

        def draw(camera: Camera, rotations: Floats, centers: Floats, *more: Any, **named: Any) -> Any:
            return joined(
                [
                    self._pipe.ask("draw", kind, named, camera, rotations[part], centers[part], *more)
                    for part in portions(camera, kind, len(centers))
                ]
            )

        return draw

    def fit(self, camera: Camera, rotations: Floats, centers: Floats, fit: Fit) -> Floats:
        """Returns the similarity of N silhouettes to a query: drawn there, compared here, some at a time."""
        similarities = [
            fit(self._pipe.ask("draw", "silhouettes", {}, camera, rotations[part], centers[part]))
            for part in portions(camera, "silhouettes", len(centers))
        ]
        return np.concatenate(similarities)


def portions(camera: Camera, kind: str, count: int) -> list[slice]:
    """Returns poses in their order, as many together as one answer may hold; one empty part for none."""
    size = max(1, _PORTION_BYTES // max(1, process.drawn_bytes(kind, camera, 1)))
    return [slice(start, start + size) for start in range(0, max(1, count), size)]


def joined(parts: list[Any]) -> Any:
    """Returns answers to parts of the poses as one."""
    first = parts[0]
    if len(parts) == 1:
        return first
    if isinstance(first, np.ndarray):
        return np.concatenate(parts)
    if isinstance(first, IouCounts):
        columns = (np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(first))
        return IouCounts(*columns)
    return tuple(chain.from_iterable(parts))


def streams_of(pipe: Pipe) -> Callable[[str, int], np.random.Generator]:
    """Returns the random numbers of a query, in the state the other end makes them in."""

    def stream(stage: str, step: int) -> np.random.Generator:
        bits = np.random.Philox()
        bits.state = pipe.ask("stream", stage, step)
        return np.random.Generator(bits)

    return stream


class Served:
    """A method, asked over a pipe."""

    def __init__(self, pipe: Pipe) -> None:
        self._pipe = pipe
        self._method: protocol.Method | None = None
        self._map: Any = None

    def make(self, settings: dict[str, Any], tilt: str) -> dict[str, Any]:
        """Makes the method; returns what there is to know of it."""
        configured = configure_method(settings).for_tilt(tilt)
        method = self._method = configured.make()
        names = frozenset(words_in(asdict(configured.params)))
        return {
            "name": method.name,
            "requires": sorted(str(word) for word in method.requires),
            "params": asdict(configured.params),
            "trial_params": asdict(method.params_for_trial())
            if isinstance(method, protocol.SupportsTrial)
            else None,
            "answers_flights": isinstance(method, protocol.SupportsFlights),
            "prepares": isinstance(method, protocol.SupportsPrepare),
            "weights": [Path(file) for file in weight_files(method)],
            "code": [code_digest(method, names=names), sys.version, version("numpy")],
        }

    def open_map(self, about: dict[str, Any]) -> None:
        """Tells of the map that is then asked about."""
        self._map = RemoteMap(self._pipe, about)

    @single_threaded_blas
    def prepare(self, references: Sequence[Reference], folder: Path) -> None:
        """Lets the method prepare."""
        assert isinstance(self._method, protocol.SupportsPrepare)  # noqa: S101
        self._method.prepare(cast("CityMap", self._map), references, protocol.Workspace(folder))

    @single_threaded_blas
    def localize(self, query: Query, offers: dict[str, bool]) -> protocol.Estimate:
        """Returns the method's estimate."""
        segment = partial(self._pipe.ask, "segment") if offers["segment"] else None
        true_pixels = partial(self._pipe.ask, "true_pixels") if offers["true_pixels"] else None
        query = replace(query, segment=segment, true_pixels=true_pixels)
        assert self._method is not None  # noqa: S101
        return self._method.localize(query, cast("CityMap", self._map), streams_of(self._pipe))


def main() -> None:
    """Answers until the pipe is closed."""
    pipe = Pipe(os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb"))
    # What is printed, by C code too, would be taken for messages.
    os.dup2(2, 1)
    # As it comes: what is said last must be why the process died.
    sys.stdout = sys.stderr
    served = Served(pipe)
    offered = {name: getattr(served, name) for name in ("make", "open_map", "prepare", "localize")}
    while True:
        name, *values = pipe.receive()["do"]
        try:
            pipe.send({"done": offered[name](*values)})
        except LodbenchError as fault:
            pipe.send(process.fault_message(fault))


if __name__ == "__main__":
    main()
