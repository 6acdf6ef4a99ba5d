"""The model's lines aligned with the photo's edges, round by round; each roof's own height is estimated, too.

Lines also choose among the modes of the search: regions take a lawn for a roof of the right size, but no
edges lie along it (docs/adr/0011, point 7).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap.laser import range_log_densities
from lodbench.estimation.optimization import maximize
from lodbench.estimation.state_vector import BASE_OFFSET, EAVE_OFFSET, OUTLINES, ROOFS, Gaussian
from lodbench.methods.protocol import Streams
from lodbench.methods.region.evidence import PhotoFit, StatePosterior
from lodbench.methods.region.line_likelihood import LineLikelihood
from lodbench.methods.region.params import RegionParams
from lodbench.methods.region.roofs import RaisedRoofs
from lodbench.methods.region.search import Problem

Floats = NDArray[np.float64]

# The photo's blur in each round, pixels, and how far outlines lie apart as it begins, of the fine size.
_ROUNDS = ((3.0, 2.5), (1.5, 1.5), (1.0, 1.0))
BLURS_PX = tuple(blur_px for blur_px, _ in _ROUNDS)
_GENERATIONS = 14
# The most that roofs, bases and eaves lie apart as a round begins, metres.
_ROOFS_APART_M = 0.5
# What a region's nat counts beside one of lines where one of the starts is chosen, and how many of them are
# aligned before.
_REGIONS_SHARE, _FOLLOWED = 0.25, 3


class LineAlignment(NamedTuple):
    """A state vector that has the model's lines on the photo's edges.

    Attributes:
        vector: (10,).
        lines: Likelihood of the edges, around it.
        regions: Posterior by regions, with each roof at a height of its own.
        sharpness: As of ``LineLikelihood``: whether the map is exact enough for lines to count.
        evidence: (M,) log-posterior of each start by lines and regions, up to a constant; -inf of those that
            were not followed. The vector comes from the best.
    """

    vector: Floats
    lines: LineLikelihood
    regions: StatePosterior
    sharpness: float
    evidence: Floats

    def log_likelihood(self, vectors: Floats, share: float = 1.0) -> Floats:
        """Returns the (N,) log-likelihood of state vectors (N, 10), of a share of the photo's nats."""
        return _log_likelihood(self.lines, self.regions, vectors, share)

    def worse_by(self, vector: Floats) -> float:
        """Returns by how many nats lines, regions and prior are less likely at a vector, (10,), than here."""
        both = np.stack([self.vector, vector])
        whole = self.log_likelihood(both) + self.regions.log_prior(both)
        return float(whole[0] - whole[1])

    def lead_over(self, other: LineAlignment) -> float:
        """Returns by how many nats its lines are likelier than another's, by the fit of either.

        Eq. (R15) of docs/methods/region.md.
        """
        both = np.stack([self.vector, other.vector])
        return min(float(lines(both) @ (1.0, -1.0)) for lines in (self.lines, other.lines))


def _log_likelihood(
    lines: LineLikelihood, regions: StatePosterior, vectors: Floats, share: float = 1.0
) -> Floats:
    # Beside each other: neither keeps two cores busy by itself.
    of_lines = lines.submit(vectors, share)
    return share * regions.log_likelihood(vectors) + of_lines()


class _Round(NamedTuple):
    """A round of the alignment: where it begins or ends, likelihoods there, and how widely it searches."""

    vector: Floats
    lines: LineLikelihood
    regions: StatePosterior
    spread: Gaussian

    def evidence(self) -> float:
        """Returns the log-posterior by lines and regions, up to a constant that all starts share.

        Eq. (R13) of docs/methods/region.md.
        """
        here = self.vector[None]
        regions = _REGIONS_SHARE * self.regions.log_likelihood(here) + self.regions.log_prior(here)
        return float((self.lines(here) + regions)[0])


class LineAligner:
    """Aligns the model's lines with the edges of one photo.

    Args:
        problem: The query, its photo and the map.
        fit: Of the photo's regions.
        params: The method's.
        streams: Of random numbers.
        has_bases: Whether lines where walls end count too.
    """

    def __init__(
        self,
        problem: Problem,
        fit: PhotoFit,
        params: RegionParams,
        streams: Streams,
        has_bases: bool = False,
    ) -> None:
        self._problem, self._fit, self._has_bases = problem, fit, has_bases
        self._params, self._streams = params, streams

    def from_best(self, starts: Floats, roofs: RaisedRoofs) -> LineAlignment | None:
        """Returns the alignment from the best of some starts, (M, 10); None without lines in view.

        The first rounds maximise the likelihood of lines, after each of which every roof is drawn where they
        have it; in the last, regions count, too. A few starts go through the first round, one goes on.
        """
        rounds = self._first_of(0, starts, roofs)
        if not rounds:
            return None
        evidence = np.full(len(starts), -np.inf)
        ranges = range_log_densities(self._problem.query, self._problem.city_map, starts)
        for k in sorted(rounds, key=lambda k: -(rounds[k].evidence() + ranges[k]))[:_FOLLOWED]:
            rounds[k] = self._maximized(0, rounds[k])
            evidence[k] = rounds[k].evidence() + ranges[k]
        best = rounds[int(evidence.argmax())]
        return self._through_rounds(1, best.vector, best.lines, roofs, evidence)

    def from_aligned(
        self, other: LineAlignment, roofs: RaisedRoofs, is_far: bool = False
    ) -> LineAlignment | None:
        """Returns the alignment from the end of one under other priors or lines; None without lines in view.

        Args:
            other: That one.
            roofs: As in the map.
            is_far: Whether it may move by metres, through all rounds, or a little, in the last.
        """
        first = 0 if is_far else len(_ROUNDS) - 1
        return self._through_rounds(first, other.vector, other.lines, roofs, other.evidence)

    def _through_rounds(
        self, first: int, vector: Floats, lines: LineLikelihood, roofs: RaisedRoofs, evidence: Floats
    ) -> LineAlignment | None:
        """Returns the alignment after the rounds from ``first`` on, from (10,)."""
        for number in range(first, len(_ROUNDS)):
            roofs = roofs.with_offsets(
                lines.own_roofs_m(vector), float(vector[BASE_OFFSET]), float(vector[EAVE_OFFSET])
            )
            rounds = self._first_of(number, vector[None], roofs)
            if not rounds:
                return None
            vector, lines, regions, _ = self._maximized(number, rounds[0])
        return LineAlignment(vector, lines, regions, lines.sharpness(vector), evidence)

    def _first_of(self, number: int, starts: Floats, roofs: RaisedRoofs) -> dict[int, _Round]:
        """Returns the beginning of a round from each of (M, 10), but for those without lines in view."""
        blur_px, spread_px = _ROUNDS[number]
        levels, query = self._problem.photo.levels(blur_px), self._problem.query
        regions = StatePosterior(query, roofs, self._fit, self._params)

        def begin(start: Floats) -> _Round | None:
            lines = LineLikelihood(levels, query, roofs, start, self._params, self._has_bases)
            prior = regions.prior_information(_ROOFS_APART_M)
            spread = self._problem.jacobian.spread(
                start[:OUTLINES], regions.at(start[ROOFS]), spread_px, prior
            )
            return _Round(start, lines, regions, spread) if len(lines) and spread is not None else None

        # The first makes what all share.
        first = [begin(start) for start in starts[:1]]
        rounds = dict(enumerate([*first, *roofs.parallel_map(begin, list(starts[1:]))]))
        return {k: each for k, each in rounds.items() if each is not None}

    def _maximized(self, number: int, start: _Round) -> _Round:
        """Returns the end of a round: the maximum of the posterior near where it begins."""
        vector, lines, regions, spread = start
        log_likelihood = partial(_log_likelihood, lines, regions) if number == len(_ROUNDS) - 1 else lines

        def posterior(vectors: Floats) -> Floats:
            return log_likelihood(vectors) + regions.log_prior(vectors)

        wide = Gaussian(vector, regions.widened(spread.covariance, _ROOFS_APART_M))
        generator = self._streams("lines", number)
        found = maximize(posterior, wide, _GENERATIONS, self._params.population, generator)
        return start._replace(vector=found.mean)
