"""A method that runs in a process of another Python, as the harness asks any other."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from lodbench import errors
from lodbench.citymap import CityMap
from lodbench.datasets.query import Query, Reference
from lodbench.geometry import Camera, Pose
from lodbench.harness.remote import process
from lodbench.methods.protocol import Estimate, Streams, Workspace
from lodbench.storage.paths import path_name

INPROCESS, SUBPROCESS = "inprocess", "subprocess"
_MODULE = "lodbench.harness.remote.child"
_MOST_BYTES = 1 << 32
# A Python that imports torch takes longer than some queries: it has at least so many seconds to start.
_START_S = 60.0


@dataclass(frozen=True, slots=True)
class RunnerParams:
    """Where a method runs, as ``conf/runner`` says.

    Raises:
        ConfigError: A value is unknown, missing or out of range.
    """

    name: str = INPROCESS
    python: str | None = None
    timeout_s: float = 600.0
    prepare_timeout_s: float = 86400.0

    def __post_init__(self) -> None:
        errors.require_choice("runner", self.name, (INPROCESS, SUBPROCESS))
        if self.name == SUBPROCESS and not self.python:
            raise errors.ConfigError("runner=subprocess needs a Python.", "Set `runner.python=PATH`.")
        errors.require_numbers(self, "runner", ("timeout_s", "prepare_timeout_s"), 0, 1e6, "(]")


@dataclass(frozen=True, slots=True)
class About:
    """What a child says of the method that it made, and what that offers."""

    name: str
    requires: list[str]
    params: dict[str, Any]
    trial_params: dict[str, Any] | None
    answers_flights: bool
    prepares: bool
    weights: list[Path]
    code: list[str]

    @classmethod
    def of(cls, message: object) -> About:
        """Returns what was said.

        Raises:
            MalformedMessage: It is no such description.
        """
        lists = {"requires": str, "weights": Path, "code": str}
        values = message if isinstance(message, dict) else {}
        is_sound = (
            values.keys() == {each.name for each in fields(cls)}
            and isinstance(values["name"], str)
            and isinstance(values["params"], dict)
            and isinstance(values["trial_params"], dict | None)
            and all(isinstance(values[name], bool) for name in ("answers_flights", "prepares"))
            and all(
                isinstance(values[name], list) and all(isinstance(item, kind) for item in values[name])
                for name, kind in lists.items()
            )
        )
        if not is_sound:
            raise process.MalformedMessage("the method's process wrote no description of the method")
        return cls(**values)


class RemoteMethod:
    """A method of another environment: made, prepared and asked there, while the map is drawn here.

    A process that dies, hangs or writes nonsense is one query's failure; the next starts another.

    Args:
        settings: The method's ``name`` and what differs from its defaults.
        runner: The other Python.
        tilt: The protocol's, ``prior`` or ``truth``.

    Attributes:
        name: The method's.
        requires: What it needs.
        params: Its parameters, as plain values.
        remote_code: What its answers depend on there: a digest of the code, and versions.
        trial_params: Parameters that it has for the trial of ``lodbench check-method``, if it has.

    Raises:
        ConfigError: The Python cannot be started or has no lodbench, the method is unknown there, a setting
            is wrong, or it answers whole flights only.
    """

    def __init__(self, settings: Mapping[str, Any], runner: RunnerParams, tilt: str = "prior") -> None:
        self._settings, self._runner, self._tilt = dict(settings), runner, tilt
        self._child: process.Child | None = None
        self._known_map: CityMap | None = None
        self._prepared_in: tuple[Sequence[Reference], Path] | None = None
        about = self._start()
        self.name = path_name("method", about.name)
        self.requires = frozenset(about.requires)
        self.params, self.trial_params = about.params, about.trial_params
        self.remote_code = about.code
        self._weights, self._prepares = about.weights, about.prepares
        if about.answers_flights:
            raise errors.ConfigError(
                f"method={self.name} answers whole flights, which go over no pipe.", "Leave out `runner=`."
            )

    def __getstate__(self) -> dict[str, Any]:
        """Returns all but the process: a worker starts its own."""
        return {**self.__dict__, "_child": None, "_known_map": None}

    def weight_files(self) -> list[Path]:
        """Returns the files that the method says it reads."""
        return self._weights

    def prepare(self, city_map: CityMap, references: Sequence[Reference], workspace: Workspace) -> None:
        """Lets the method prepare, if it does.

        Raises:
            LodbenchError: It cannot.
        """
        self._prepared_in = (references, workspace.folder)
        self._known_map = None
        try:
            self._send_map(city_map)
        except process.ProcessFault as fault:
            raise errors.ConfigError(f"method={self.name} cannot prepare: {fault}.") from fault

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the method's estimate.

        Raises:
            QueryFault: The method says there is none.
            ProcessFault: Its process died, hung or wrote nonsense.
        """
        self._send_map(city_map)
        offers = {"segment": query.segment is not None, "true_pixels": query.true_pixels is not None}

        def answer(words: list[Any]) -> Any:
            return answered(words, query, city_map, streams)

        estimate = self._call(["localize", query, offers], answer, self._runner.timeout_s)
        if not isinstance(estimate, Estimate):
            raise TypeError(f"localize returned {type(estimate).__name__} instead of an Estimate")
        return estimate

    def close(self) -> None:
        """Ends the process, if there is one."""
        if self._child is not None:
            self._child.close()
        self._child = None

    def _start(self) -> About:
        """Starts a process and makes the method there; returns what there is to know of it."""
        # What this environment tells its Python is no matter of the other's.
        kept = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
        # -P: nothing is imported from the folder that this was started in; plug-ins are installed there.
        child = self._child = process.Child([cast("str", self._runner.python), "-P", "-m", _MODULE], kept)
        weakref.finalize(self, child.close)
        self._known_map = None
        try:
            made = self._call(
                ["make", self._settings, self._tilt], _nothing, max(_START_S, self._runner.timeout_s)
            )
            return About.of(made)
        except (process.ProcessFault, process.MalformedMessage) as fault:
            self.close()
            raise process.RunnerFault(
                f"runner.python={self._runner.python}: {fault}.",
                "lodbench must be installed there, and the method's package.",
            ) from fault

    def _send_map(self, city_map: CityMap) -> None:
        """Makes sure that there is a process, prepared, that knows the map."""
        if self._child is None:
            self._start()
        if self._known_map is city_map:
            return
        about = {"name": city_map.name, "threads": city_map.threads, "is_textured": city_map.is_textured}
        self._call(["open_map", about], _nothing, self._runner.timeout_s)
        if self._prepares and self._prepared_in is not None:
            self._call(
                ["prepare", *self._prepared_in],
                lambda words: answered(words, None, city_map, _no_streams),
                self._runner.prepare_timeout_s,
            )
        # Not before: a process that could not prepare is asked to again.
        self._known_map = city_map

    def _call(self, words: list[Any], answer: Callable[[list[Any]], Any], timeout_s: float) -> Any:
        assert self._child is not None  # noqa: S101
        try:
            message = self._child.call({"do": words}, answer, timeout_s)
        except (process.ProcessFault, errors.WorkersGone):
            self._child = None
            raise
        if "fault" in message:
            raise process.fault_of(message)
        return message.get("done")


def _nothing(words: list[Any]) -> Any:
    raise errors.LodbenchError(f"there is nothing to ask yet: {words[:2]}")


def _no_streams(stage: str, step: int) -> np.random.Generator:
    raise errors.LodbenchError("random numbers are a query's")


def answered(words: list[Any], query: Query | None, city_map: CityMap, streams: Streams) -> Any:
    """Returns the answer to what a child asks.

    Raises:
        LodbenchError: There is no such thing to ask, or its answer would be too large.
        Exception: Whatever comes of arguments that are none.
    """
    kind, *values = words or [""]
    if kind == "scene":
        return city_map.scene
    if kind == "stream":
        stage, step = values
        return streams(str(stage), int(step)).bit_generator.state
    if kind == "count":
        return _counted(city_map, *values)
    if kind == "segment" and query is not None and query.segment is not None:
        return query.segment(_pose(*values))
    if kind == "true_pixels" and query is not None and query.true_pixels is not None:
        return query.true_pixels(np.asarray(values[0], dtype=np.float64))
    if kind == "draw" and values and values[0] in process.KINDS:
        return _drawn(city_map, *values)
    raise errors.LodbenchError(f"there is no {kind!r} to ask for")


def _counted(city_map: CityMap, kind: str, poses: int) -> None:
    if not isinstance(poses, int) or poses < 0:
        raise errors.RenderingError(f"{poses!r} poses cannot be counted")
    city_map.usage.add(str(kind), poses)


def _drawn(city_map: CityMap, kind: str, named: dict[str, Any], camera: Any, *arguments: Any) -> Any:
    if not isinstance(camera, Camera) or not arguments:
        raise errors.RenderingError(f"{kind} is requested with a camera and poses")
    views = 1 if kind == "render" else len(arguments[0])
    if not 0 <= process.drawn_bytes(kind, camera, views) <= _MOST_BYTES:
        raise errors.RenderingError(
            f"{views} views of {camera.width} x {camera.height} are too many at a time"
        )
    return getattr(city_map, kind)(camera, *arguments, **named)


def _pose(*values: Any) -> Pose:
    if len(values) != 1 or not isinstance(values[0], Pose):
        raise errors.QueryFault("a mask is requested from a pose")
    return replace(values[0])
