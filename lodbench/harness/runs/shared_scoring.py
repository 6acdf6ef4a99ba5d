"""Large grids of one query, scored by all workers: the numbers are those of one process, to the bit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.execution.executor import Workers
from lodbench.geometry import Camera
from lodbench.rendering import Fit, IouCounts, IouFit
from lodbench.rendering.nearby import nearby_order
from lodbench.rendering.protocol import Scorer

Floats = NDArray[np.float64]

# Hypotheses handed to a worker at a time: a second or so of work, against milliseconds to send them.
PART = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Some hypotheses of a call.

    Attributes:
        which: Their places in the call.
        camera: Pinhole.
        rotations: (N, 3, 3) cam_from_world.
        centers: (N, 3) camera centres, scene metres.
        fit: What they are compared with.
    """

    which: NDArray[np.int64]
    camera: Camera
    rotations: Floats
    centers: Floats
    fit: Fit


def score(scorer: Scorer, part: Part) -> tuple[NDArray[np.int64], tuple[NDArray[Any], ...]]:
    """Returns the places of hypotheses and what they score: intersection and union for an ``IouFit``."""
    if isinstance(part.fit, IouFit):
        counts = scorer.counts(part.camera, part.rotations, part.centers, part.fit.mask)
        return part.which, (counts.intersection, counts.union)
    return part.which, (scorer.fit(part.camera, part.rotations, part.centers, part.fit),)


class SharedScorer:
    """A renderer that shares large calls of ``counts`` and ``fit`` out over workers; the rest it does here.

    Args:
        own: This process's renderer.
        workers: Each has the same city open.
        work: Module-level function that scores a part in a worker, as ``score`` does.
        part: Hypotheses in a part; a call of less than two is done here.
    """

    def __init__(self, own: Scorer, workers: Workers, work: Any, part: int = PART) -> None:
        self._own, self._workers, self._work, self._part = own, workers, work, part

    def __getattr__(self, name: str) -> Any:
        return getattr(self._own, name)

    def counts(
        self, camera: Camera, rotations: Floats, centers: Floats, mask: NDArray[np.bool_]
    ) -> IouCounts:
        """Counts as ``Scorer.counts`` does."""
        if len(centers) < 2 * self._part:
            return self._own.counts(camera, rotations, centers, mask)
        return IouCounts(*self._shared(camera, rotations, centers, IouFit(mask), (np.int64, np.int64)))

    def fit(self, camera: Camera, rotations: Floats, centers: Floats, fit: Fit) -> Floats:
        """Compares as ``Scorer.fit`` does."""
        if isinstance(fit, IouFit):
            return self.counts(camera, rotations, centers, fit.mask).iou()
        if len(centers) < 2 * self._part:
            return self._own.fit(camera, rotations, centers, fit)
        return self._shared(camera, rotations, centers, fit, (np.float64,))[0]

    def _shared(
        self, camera: Camera, rotations: Floats, centers: Floats, fit: Fit, kinds: tuple[type, ...]
    ) -> tuple[NDArray[Any], ...]:
        """Returns what each hypothesis scores, whatever the order in which parts come back."""
        results: tuple[NDArray[Any], ...] = tuple(np.zeros(len(centers), dtype=kind) for kind in kinds)
        # Neighbours see much the same buildings: a part of them is drawn faster than one of all places.
        order = nearby_order(rotations, centers)

        def parts() -> Iterator[Part]:
            for start in range(0, len(order), self._part):
                which = order[start : start + self._part]
                yield Part(which, camera, rotations[which], centers[which], fit)

        for which, scored in self._workers.map(self._work, parts()):
            for result, values in zip(results, scored, strict=True):
                result[which] = values
        return results
