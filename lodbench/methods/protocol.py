"""What a localisation method is."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Query
from lodbench.geometry import Pose
from lodbench.rendering import Scorer

# Random numbers of one query: a stage's name and a step give a generator of their own.
Streams = Callable[[str, int], np.random.Generator]


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """A method's answer to one query.

    Attributes:
        pose: The camera's pose, scene frame.
        score: The method's own measure of fit, higher is better.
        hypotheses: Poses rendered and compared.
        seconds: Wall time by stage.
        trace: Best score after each step of each stage.
        covariance: (6, 6) of the error in x, y, z (metres), pitch, roll and yaw (degrees), where the
            method knows it.
        probability: That the pose is within 2 m and 2 degrees, where the method knows it.
    """

    pose: Pose
    score: float
    hypotheses: int
    seconds: dict[str, float] = field(default_factory=dict)
    trace: dict[str, tuple[float, ...]] = field(default_factory=dict)
    covariance: NDArray[np.float64] | None = None
    probability: float | None = None


class Method(Protocol):
    """Finds the pose of a query in a scene.

    A method is made from its ``Params`` and holds no state between queries. It is never shown the
    truth, and draws random numbers only from the streams it is given.

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

    def localize(self, query: Query, scorer: Scorer, streams: Streams) -> Estimate:
        """Returns the estimated pose.

        Args:
            query: Camera, prior and building mask, in the scene's frame.
            scorer: Renders and scores hypotheses; ``scorer.scene`` is the city.
            streams: Random numbers of this query.

        Raises:
            QueryFault: There is no estimate; the reason becomes the query's row.
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
