"""What a localisation method is, and the workspace for what it prepares: a folder, filled in parts."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from lodbench.errors import LodbenchError, QueryFault
from lodbench.storage import digest_of, write_text
from lodbench.storage.digest import file_check
from lodbench.storage.disk import disk, make_folder
from lodbench.storage.paths import cache_limit_bytes, cache_root, mark_used, path_name, prune_cache

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lodbench.citymap import CityMap
    from lodbench.datasets.prior_sources import UniformPrior
    from lodbench.datasets.query import Query, Reference
    from lodbench.geometry import Pose

# Random numbers of one query: a stage's name and a step give a generator of their own.
Streams = Callable[[str, int], np.random.Generator]


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """A method's answer to one query.

    Attributes:
        pose: The camera's pose, scene frame.
        score: The method's own measure of fit, higher is better.
        hypotheses: Poses drawn; counted by the map, whatever the method says.
        seconds: Wall time by stage, for a method that states stages; the whole is measured.
        trace: Best score after each step of each stage. Of other numbers the name ends with their unit in
            brackets; ``[nats]`` is what is known of the answers found, best first.
        covariance: (6, 6) of the error in x, y, z (metres), pitch, roll and yaw (degrees), where the
            method knows it.
        probability: That the pose is within 2 m and 2 degrees, where the method knows it.
        alternatives: Other poses that fit nearly as well, best first, where the method looks for them.
        alternative_probabilities: How probable it is that the camera is near each of these rather, where the
            method knows it.
        notes: What a reader should know of the answer, in sentences.
        mask: The mask that the answer rests on, where the method had it made (``Query.segment``).
        is_laser_used: Whether pose and covariance include a laser's range (``assessment.assessed``).
        is_assessed: Whether covariance and probability went through ``assessment.assessed`` already.
    """

    pose: Pose
    score: float
    hypotheses: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    trace: dict[str, tuple[float, ...]] = field(default_factory=dict, repr=False)
    covariance: NDArray[np.float64] | None = field(default=None, repr=False)
    probability: float | None = None
    alternatives: tuple[Pose, ...] = ()
    alternative_probabilities: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()
    mask: NDArray[np.float32] | None = field(default=None, repr=False)
    is_laser_used: bool = False
    is_assessed: bool = False


class Method(Protocol):
    """Finds the pose of a query on a map.

    A method is made from its parameters and holds no state but what ``prepare`` made. It is never shown
    the truth, and draws random numbers only from the streams it is given.

    Attributes:
        name: As its entry point's.
        requires: What it needs besides the camera, the prior and the city, of
            ``lodbench.datasets.inputs.Input``: a run without it ends before any work.
    """

    name: str

    @property
    def requires(self) -> Collection[str]:
        """Returns the names of what it needs; a class attribute will do."""
        ...

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the estimated pose.

        Args:
            query: Camera, prior and, where it is required, building mask, in the scene's frame.
            city_map: Draws the city from any pose, and counts; ``city_map.scene`` is its geometry.
            streams: Random numbers of this query.

        Raises:
            QueryFault: There is no estimate; the reason becomes the query's row.
        """
        ...


@runtime_checkable
class SupportsPrepare(Protocol):
    """A method that makes something of the map once, before the first query: a database of features."""

    def prepare(self, city_map: CityMap, references: Sequence[Reference], workspace: Workspace) -> None:
        """Makes, or finds made, what ``localize`` needs; called once before any query.

        Args:
            city_map: The map.
            references: Posed pictures of the place, scene frame; empty where the dataset has none.
            workspace: Keeps what is made, part by part, for the next time.

        Raises:
            LodbenchError: It cannot be made; the run ends.
        """
        ...


@runtime_checkable
class SupportsBatches(Protocol):
    """A method that is faster at several queries at a time.

    Attributes:
        batch_size: At most so many at a time.
    """

    batch_size: int

    def localize_batch(
        self, queries: Sequence[Query], city_map: CityMap, streams: Sequence[Streams]
    ) -> Sequence[Estimate | QueryFault]:
        """Returns what ``localize`` answers to each query, or would raise."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class FlightEstimate:
    """A method's answer to a whole flight.

    Attributes:
        estimates: One per photo, or why there is none.
        findings: What the flight says besides, as JSON values; stored with the run.
    """

    estimates: Sequence[Estimate | QueryFault]
    findings: dict[str, Any] = field(default_factory=dict)


@runtime_checkable
class SupportsFlights(Protocol):
    """A method that answers all photos of a flight together; it always answers whole flights."""

    def localize_flight(
        self, queries: Sequence[Query], city_map: CityMap, streams: Sequence[Streams]
    ) -> FlightEstimate:
        """Returns the answers to the queries of one flight, in their order."""
        ...


@runtime_checkable
class SupportsPhotosAlone(SupportsFlights, Protocol):
    """A method for flights whose answer is ``solve`` of ``localize_alone``, which any process may do."""

    def localize_alone(
        self, queries: Sequence[Query], city_map: CityMap, streams: Sequence[Streams]
    ) -> Sequence[Estimate | QueryFault]:
        """Returns what each photo of a flight says by itself, in their order; none depends on another."""
        ...

    def solve(
        self, queries: Sequence[Query], alone: Sequence[Estimate | QueryFault], city_map: CityMap
    ) -> FlightEstimate:
        """Returns what ``localize_flight`` does, given what ``localize_alone`` returned."""
        ...


class Follower(Protocol):
    """What a method knows of a sequence so far."""

    def next(self, query: Query, streams: Streams) -> Estimate:
        """Returns the estimated pose of the query that was taken next.

        Raises:
            QueryFault: There is no estimate; the sequence goes on.
        """
        ...


@runtime_checkable
class SupportsSequences(Protocol):
    """A method that answers queries as they come, in the order they were taken, each from those before."""

    def begin(self, first: Query, city_map: CityMap) -> Follower:
        """Returns what answers a sequence, given the camera and the prior of its first query."""
        ...


@runtime_checkable
class SupportsWeights(Protocol):
    """A method that reads files besides its code: a run's digest names their content."""

    def weight_files(self) -> Sequence[Path]:
        """Returns the files."""
        ...


@runtime_checkable
class SupportsTraining(Protocol):
    """A method that learns, as a class: ``lodbench train method=NAME`` asks it.

    Attributes:
        training_type: A frozen dataclass of settings; ``data``, ``val_data``, ``out``, ``seed``, ``threads``,
            ``resume`` and ``init`` are the command's, the others those of ``conf/schedule/NAME.yaml``.
    """

    training_type: type[Any]

    @staticmethod
    def train(settings: Any, tell: Callable[[str], None]) -> Path:
        """Trains, or goes on where the same settings were stopped; returns the file of the weights.

        Args:
            settings: Of ``training_type``.
            tell: Called with a line at a time.

        Raises:
            LodbenchError: A library is missing, or the data is at fault.
        """
        ...


@runtime_checkable
class SupportsPriorWidth(Protocol):
    """A method whose search can be fitted to how far off a prior may be."""

    def params_for_prior(self, prior: UniformPrior) -> Any:
        """Returns the method's parameters, set to search all within the half widths of a prior's error."""
        ...


@runtime_checkable
class SupportsTrueTilt(Protocol):
    """A method that searches or weighs the prior's tilt, and need not where the tilt is the true one."""

    def params_for_true_tilt(self) -> Any:
        """Returns the method's parameters for priors whose pitch and roll are exact (``tilt=truth``)."""
        ...


@runtime_checkable
class SupportsTrial(Protocol):
    """A method that has no answer about the trial of ``check-method`` but under settings of its own.

    The trial has a few blocks of plain colours: nothing that a picture of another kind could be matched with.

    Attributes:
        params: Its parameters, a dataclass; what the trial changes of them is reported.
    """

    params: Any

    def params_for_trial(self) -> Any:
        """Returns the method's parameters for the trial."""
        ...


_LOGGER = logging.getLogger(__name__)
_FOLDER = "prepared"


class Workspace:
    """A folder that a method's ``prepare`` fills, and finds filled the next time.

    Its name stands for all that its content depends on: the method, its parameters, code and weights, the
    map and the references. So a part that is there is the right one, and is never made again, unless it
    is no longer what was written, which is logged. Every part is there whole or not at all: after a kill the
    finished ones stay.

    Args:
        folder: The folder; made if it is not there.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        make_folder(folder)

    def part(self, name: str, make: Callable[[Path], None]) -> Path:
        """Returns a part's file, made first if it is not there.

        Args:
            name: The file's name, without folders.
            make: Writes the part to the path it is given, which ends as the name does; a file, or a folder.

        Raises:
            LodbenchError: The name is no plain name, or ``make`` wrote nothing there.
            Exception: What ``make`` raised; the part is not there then.
        """
        path = self.folder / path_name("part's", name)
        is_damaged = path.exists()
        if is_damaged:
            if _stored_check(path) == _check(path):
                return path
            _LOGGER.warning("%s, which a method prepared, is damaged: it is made anew.", path)
        self._make(path, make, is_damaged)
        return path

    def _make(self, path: Path, make: Callable[[Path], None], is_damaged: bool) -> None:
        unfinished = path.with_name(f".{os.getpid()}.{path.name}")
        try:
            make(unfinished)
            if not unfinished.exists():
                raise LodbenchError(
                    f"Nothing was written for the part {path.name}.", "Write to the path given."
                )
            # First: who finds the part finds what it must be.
            write_text(_check_file(path), _check(unfinished), survives_power_cut=False)
            if is_damaged:
                disk().remove(path)
            try:
                disk().rename(unfinished, path)
            except OSError:
                # Another process may have made a folder of the same content meanwhile.
                if not path.exists():
                    raise
        finally:
            disk().remove(unfinished)


def _check_file(path: Path) -> Path:
    return path.with_name(f".{path.name}.xxh3")


def _stored_check(path: Path) -> str | None:
    try:
        return _check_file(path).read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None


def _check(path: Path) -> str:
    """Returns a digest by which damage of a file, or of any file of a folder, shows."""
    if path.is_file():
        return file_check(path)
    files = sorted(file for file in path.rglob("*") if file.is_file())
    return digest_of([[file.relative_to(path).as_posix(), file_check(file)] for file in files], length=32)


def open_workspace(method: str, digest: str) -> Workspace:
    """Returns the workspace of a method for a content, in the cache; the longest unused make room for it."""
    root = cache_root() / _FOLDER
    workspace = Workspace(root / f"{path_name('method', method)}-{digest}")
    mark_used(workspace.folder)
    prune_cache(root, cache_limit_bytes(), keep=workspace.folder)
    return workspace
