"""What a localisation method is."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from lodbench.citymap import CityMap
    from lodbench.datasets.prior_sources import UniformPrior
    from lodbench.datasets.query import Query, Reference
    from lodbench.errors import QueryFault
    from lodbench.geometry import Pose
    from lodbench.methods.workspace import Workspace

# Random numbers of one query: a stage's name and a step give a generator of their own.
Streams = Callable[[str, int], np.random.Generator]


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """A method's answer to one query.

    Attributes:
        pose: The camera's pose, scene frame.
        score: The method's own measure of fit, higher is better.
        hypotheses: Poses drawn; counted by the map, whatever the method says.
        seconds: Wall time by stage, for a method that tells stages; the whole is measured.
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
    """A method that answers all photos of a flight together; it is always asked for whole flights."""

    def localize_flight(
        self, queries: Sequence[Query], city_map: CityMap, streams: Sequence[Streams]
    ) -> FlightEstimate:
        """Returns the answers to the queries of one flight, in their order."""
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
        """Returns the method's parameters, set to search all that such a prior leaves open.

        Args:
            prior: Half widths of the prior's error.
        """
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
        params: Its parameters, a dataclass; what the trial changes of them is told.
    """

    params: Any

    def params_for_trial(self) -> Any:
        """Returns the method's parameters for the trial."""
        ...
