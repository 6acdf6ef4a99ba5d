"""The model's lines put on the photo's edges, round by round, while each roof finds its own height."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.methods.protocol import Streams
from lodbench.methods.region.evolution import Cloud, climb
from lodbench.methods.region.lines import LineFit
from lodbench.methods.region.params import Params
from lodbench.methods.region.roofs import RaisedRoofs, RoofEvidence
from lodbench.methods.region.search import Surroundings

Floats = NDArray[np.float64]

# The photo's blur in each round, pixels, and how far outlines lie apart as it begins, of the fine size.
_ROUNDS = ((3.0, 2.5), (1.5, 1.5), (1.0, 1.0))
_GENERATIONS = 14
# How far roofs lie apart as a round begins, metres.
_ROOFS_APART_M = 0.5


class Aligned(NamedTuple):
    """A pose and a height of roofs that put the model's lines on the photo's edges.

    Attributes:
        vector: (8,) both.
        lines: What edges say of others.
        regions: What regions and prior say of them, with each roof at a height of its own.
        sharpness: As of ``LineFit``: whether the map is exact enough for it to count.
    """

    vector: Floats
    lines: LineFit
    regions: RoofEvidence
    sharpness: float

    def nats(self, vectors: Floats, share: float = 1.0) -> Floats:
        """Returns the (N,) logarithm of the likelihood of such, (N, 8), of a share of the photo's nats."""
        return self.lines(vectors, share) + share * self.regions.nats(vectors)


def aligned_by_lines(
    photo: NDArray[Any],
    query: Query,
    roofs: RaisedRoofs,
    vector: Floats,
    regions_of: Callable[[RaisedRoofs], RoofEvidence],
    around: Surroundings,
    params: Params,
    streams: Streams,
) -> Aligned | None:
    """Returns what is near (8,) and puts the model's lines on the photo's edges; None without lines in view.

    Lines alone lead in the first rounds, after which each roof is drawn where they put it; in the last the
    regions have their say too.
    """
    for number, (blur_px, spread_px) in enumerate(_ROUNDS):
        is_last = number == len(_ROUNDS) - 1
        lines, regions = LineFit(photo, query, roofs, vector, blur_px, params), regions_of(roofs)
        cloud = around.cloud(vector[:6], regions.at(vector[6]), spread_px)
        if not len(lines) or cloud is None:
            return None
        nats = Aligned(vector, lines, regions, 0.0).nats if is_last else lines
        vector = _climbed(nats, regions, vector, cloud, params.population, streams("lines", number))
        if not is_last:
            roofs = roofs.each_by_itself(lines.own_roofs_m(vector), float(vector[7]))
    return Aligned(vector, lines, regions, lines.sharpness(vector))


def _climbed(
    nats: Callable[[Floats], Floats],
    regions: RoofEvidence,
    vector: Floats,
    cloud: Cloud,
    population: int,
    generator: np.random.Generator,
) -> Floats:
    def posterior(vectors: Floats) -> Floats:
        return nats(vectors) + regions.log_prior(vectors)

    start = Cloud(vector, regions.widened(cloud.covariance, _ROOFS_APART_M))
    return climb(posterior, start, _GENERATIONS, population, generator).mean
