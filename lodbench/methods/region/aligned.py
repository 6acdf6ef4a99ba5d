"""The model's lines put on the photo's edges, round by round, while each roof finds its own height.

Which of the search's tops to go on from is told by lines, too: regions take a lawn for a roof of the right
size, but no edges lie along it (docs/adr/0055).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.methods.protocol import Streams
from lodbench.methods.region.evolution import Cloud, maximize
from lodbench.methods.region.lines import LineFit
from lodbench.methods.region.params import BASE_OFFSET, EAVE_OFFSET, OUTLINES, ROOFS, Params
from lodbench.methods.region.roofs import RaisedRoofs, RoofEvidence
from lodbench.methods.region.search import OutlineJacobian
from lodbench.rendering.photo_bins import Levels

Floats = NDArray[np.float64]

# The photo's blur in each round, pixels, and how far outlines lie apart as it begins, of the fine size.
_ROUNDS = ((3.0, 2.5), (1.5, 1.5), (1.0, 1.0))
BLURS_PX = tuple(blur_px for blur_px, _ in _ROUNDS)
_GENERATIONS = 14
# How far roofs, feet and eaves lie apart as a round begins at most, metres.
_ROOFS_APART_M = 0.5
# What a region's nat counts beside one of lines where one of the starts is chosen, and how many are followed
# to tell.
_REGIONS_SHARE, _FOLLOWED = 0.25, 3


class Aligned(NamedTuple):
    """A camera and roofs, feet and eaves that put the model's lines on the photo's edges.

    Attributes:
        vector: (10,) all of them.
        lines: What edges say of others.
        regions: What regions and prior say of them, with each roof at a height of its own.
        sharpness: As of ``LineFit``: whether the map is exact enough for it to count.
        evidence: (M,) the logarithm of what lines, regions and prior say of each start, up to a constant;
            -inf of those that were not followed. The vector comes from the best.
    """

    vector: Floats
    lines: LineFit
    regions: RoofEvidence
    sharpness: float
    evidence: Floats

    def log_likelihood(self, vectors: Floats, share: float = 1.0) -> Floats:
        """Returns the (N,) logarithm of the likelihood of such, (N, 10), of a share of the photo's nats."""
        return _log_likelihood(self.lines, self.regions, vectors, share)

    def worse_by(self, vector: Floats) -> float:
        """Returns by how many nats lines, regions and prior are less likely at a vector, (10,), than here."""
        both = np.stack([self.vector, vector])
        whole = self.log_likelihood(both) + self.regions.log_prior(both)
        return float(whole[0] - whole[1])

    def lead_over(self, other: Aligned) -> float:
        """Returns by how many nats its lines are likelier than another's, at least in the eyes of either.

        Eq. (R15) of docs/methods/region.md.
        """
        both = np.stack([self.vector, other.vector])
        return min(float(lines(both) @ (1.0, -1.0)) for lines in (self.lines, other.lines))


def _log_likelihood(lines: LineFit, regions: RoofEvidence, vectors: Floats, share: float = 1.0) -> Floats:
    # Beside each other: neither keeps two cores busy by itself.
    of_lines = lines.begun(vectors, share)
    return share * regions.log_likelihood(vectors) + of_lines()


class _Round(NamedTuple):
    """What a round sees, and where it begins or ends."""

    vector: Floats
    lines: LineFit
    regions: RoofEvidence
    cloud: Cloud

    def evidence(self) -> float:
        """Returns the logarithm of what speaks for where it is, up to a constant that all starts share.

        Eq. (R13) of docs/methods/region.md.
        """
        here = self.vector[None]
        regions = _REGIONS_SHARE * self.regions.log_likelihood(here) + self.regions.log_prior(here)
        return float((self.lines(here) + regions)[0])


class Alignment:
    """Lays the model's lines over one photo.

    Args:
        levels_at: How strongly the photo changes, as of ``Photo.levels``, after a blur, pixels.
        query: The query.
        regions_of: What regions and prior say, of roofs.
        around: How the outline moves.
        params: The method's.
        streams: Of random numbers.
        has_bases: Whether lines where walls end count too.
    """

    def __init__(
        self,
        levels_at: Callable[[float], Levels],
        query: Query,
        regions_of: Callable[[RaisedRoofs], RoofEvidence],
        around: OutlineJacobian,
        params: Params,
        streams: Streams,
        has_bases: bool = False,
    ) -> None:
        self._has_bases = has_bases
        self._levels_at, self._query, self._regions_of = levels_at, query, regions_of
        self._around, self._params, self._streams = around, params, streams

    def from_best(self, starts: Floats, roofs: RaisedRoofs) -> Aligned | None:
        """Returns what is near the best of (M, 10) and puts lines on edges; None without lines in view.

        Lines alone lead in the first rounds, after which each roof is drawn where they put it; in the last
        the regions have their say too. Only a few starts are followed through the first, one from there on.
        """
        begun = self._begun(0, starts, roofs)
        if not begun:
            return None
        evidence = np.full(len(starts), -np.inf)
        for k in sorted(begun, key=lambda k: -begun[k].evidence())[:_FOLLOWED]:
            begun[k] = self._ended(0, begun[k])
            evidence[k] = begun[k].evidence()
        found = begun[int(evidence.argmax())]
        return self._refined(1, found.vector, found.lines, roofs, evidence)

    def from_aligned(self, other: Aligned, roofs: RaisedRoofs, is_far: bool = False) -> Aligned | None:
        """Returns what is near a place that another belief led to; None without lines in view.

        Args:
            other: There.
            roofs: As in the map.
            is_far: Whether the belief may move it by metres, in all rounds, or a little, in the last.
        """
        first = 0 if is_far else len(_ROUNDS) - 1
        return self._refined(first, other.vector, other.lines, roofs, other.evidence)

    def _refined(
        self, first: int, vector: Floats, lines: LineFit, roofs: RaisedRoofs, evidence: Floats
    ) -> Aligned | None:
        """Returns where all rounds from the first lead to from (10,)."""
        for number in range(first, len(_ROUNDS)):
            roofs = roofs.each_by_itself(
                lines.own_roofs_m(vector), float(vector[BASE_OFFSET]), float(vector[EAVE_OFFSET])
            )
            begun = self._begun(number, vector[None], roofs)
            if not begun:
                return None
            vector, lines, regions, _ = self._ended(number, begun[0])
        return Aligned(vector, lines, regions, lines.sharpness(vector), evidence)

    def _begun(self, number: int, starts: Floats, roofs: RaisedRoofs) -> dict[int, _Round]:
        """Returns what a round sees from each of (M, 10), but for those without lines in view."""
        blur_px, spread_px = _ROUNDS[number]
        levels, regions = self._levels_at(blur_px), self._regions_of(roofs)

        def begin(start: Floats) -> _Round | None:
            lines = LineFit(levels, self._query, roofs, start, self._params, self._has_bases)
            prior = regions.prior_information(_ROOFS_APART_M)
            cloud = self._around.cloud(start[:OUTLINES], regions.at(start[ROOFS]), spread_px, prior)
            return _Round(start, lines, regions, cloud) if len(lines) and cloud is not None else None

        # The first makes what all share.
        first = [begin(start) for start in starts[:1]]
        begun = dict(enumerate([*first, *roofs.side_by_side(begin, list(starts[1:]))]))
        return {k: each for k, each in begun.items() if each is not None}

    def _ended(self, number: int, begun: _Round) -> _Round:
        """Returns where a round ends."""
        vector, lines, regions, cloud = begun
        log_likelihood = partial(_log_likelihood, lines, regions) if number == len(_ROUNDS) - 1 else lines

        def posterior(vectors: Floats) -> Floats:
            return log_likelihood(vectors) + regions.log_prior(vectors)

        start = Cloud(vector, regions.widened(cloud.covariance, _ROOFS_APART_M))
        generator = self._streams("lines", number)
        top = maximize(posterior, start, _GENERATIONS, self._params.population, generator)
        return begun._replace(vector=top.mean)
