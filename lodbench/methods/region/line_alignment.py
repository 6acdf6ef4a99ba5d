"""The model's lines aligned with the photo's edges in rounds; the height of each roof is estimated as well.

Lines also choose among the modes of the search: regions mistake a lawn for a roof of the same size, but no
edges lie along its outline (docs/adr/0011, point 7).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap.laser import range_log_densities
from lodbench.estimation.optimization import maximize
from lodbench.estimation.state_vector import ALL_BASES, ALL_OVERHANGS, ALL_ROOFS, NUM_WITH_BASES, Gaussian
from lodbench.methods.protocol import Streams
from lodbench.methods.region.line_likelihood import LineLikelihood
from lodbench.methods.region.params import RegionParams
from lodbench.methods.region.posteriors import PhotoFit, StatePosterior
from lodbench.methods.region.roofs import RaisedRoofs
from lodbench.methods.region.search import QueryContext

Floats = NDArray[np.float64]

# By round: the photo's blur, and how far apart outlines lie in the first generation, pixels of the fine size.
_ROUNDS = ((3.0, 2.5), (1.5, 1.5), (1.0, 1.0))
BLURS_PX = tuple(blur_px for blur_px, _ in _ROUNDS)
_GENERATIONS = 14
# The largest standard deviation of roofs, bases and overhangs in a first generation, metres.
_MOST_SIGMA_M = 0.5
# The exponent of the regions' likelihood, next to that of lines, where one of the starts is chosen.
_REGION_EXPONENT = 0.25
# The number of starts that go through the first round.
_NUM_FOLLOWED = 3


class LineAlignment(NamedTuple):
    """A state vector at which the model's lines lie on the photo's edges.

    Attributes:
        vector: (10,) the state vector.
        line_likelihood: likelihood of the edges near it.
        region_posterior: posterior by regions, each roof drawn at its own height.
        sharpness: sharpness of the edges, as returned by ``LineLikelihood.sharpness``.
        log_posteriors: (M,) log-posterior of each start by lines and regions, (R13), up to a constant; -inf
            for starts that were not followed. The vector comes from the best.
    """

    vector: Floats
    line_likelihood: LineLikelihood
    region_posterior: StatePosterior
    sharpness: float
    log_posteriors: Floats

    def log_likelihood(self, vectors: Floats, temper: float = 1.0) -> Floats:
        """Returns the (N,) log-likelihood of state vectors (N, 10), tempered by an exponent."""
        return _log_likelihood(self.line_likelihood, self.region_posterior, vectors, temper)

    def worse_by(self, vector: Floats) -> float:
        """Returns by how many nats the log-posterior by lines and regions is lower at (10,) than here."""
        both = np.stack([self.vector, vector])
        log_posterior = self.log_likelihood(both) + self.region_posterior.log_prior(both)
        return float(log_posterior[0] - log_posterior[1])

    def lead_over(self, other: LineAlignment) -> float:
        """Returns by how many nats its lines are likelier than another's, the smaller by either's lines.

        Eq. (R15) of docs/methods/region.md.
        """
        both = np.stack([self.vector, other.vector])
        by_lines_of = self.line_likelihood, other.line_likelihood
        return min(float(line_likelihood(both) @ (1.0, -1.0)) for line_likelihood in by_lines_of)


def _log_likelihood(
    line_likelihood: LineLikelihood, region_posterior: StatePosterior, vectors: Floats, temper: float = 1.0
) -> Floats:
    # Concurrently: neither keeps two cores busy by itself.
    by_lines = line_likelihood.submit(vectors, temper)
    return temper * region_posterior.log_likelihood(vectors) + by_lines()


class _Round(NamedTuple):
    """The beginning or end of a round: a vector, (10,), the likelihoods there, and the first generation."""

    vector: Floats
    line_likelihood: LineLikelihood
    region_posterior: StatePosterior
    initial_gaussian: Gaussian

    def log_posterior(self) -> float:
        """Returns the log-posterior by lines and regions, up to a constant that all starts share.

        Eq. (R13) of docs/methods/region.md, its first half without the laser's range.
        """
        here, regions = self.vector[None], self.region_posterior
        by_regions = _REGION_EXPONENT * regions.log_likelihood(here) + regions.log_prior(here)
        return float((self.line_likelihood(here) + by_regions)[0])


class LineAligner:
    """Aligns the model's lines with the edges of one photo.

    Args:
        context: the query, its photo and the map.
        fit: the fit of the photo's regions.
        params: the method's parameters.
        streams: random streams.
        has_bases: whether lines at bases of walls are used as well.
    """

    def __init__(
        self,
        context: QueryContext,
        fit: PhotoFit,
        params: RegionParams,
        streams: Streams,
        has_bases: bool = False,
    ) -> None:
        self._context, self._fit, self._has_bases = context, fit, has_bases
        self._params, self._streams = params, streams

    def from_best(self, starts: Floats, roofs: RaisedRoofs) -> LineAlignment | None:
        """Returns the alignment from the best of some starts, (M, 10); None without lines in view.

        The first two rounds maximise the posterior by lines. Before each round but the first, every roof is
        drawn at the height that lines give it. In the last round regions are used as well. A few starts go
        through the first round, one through the others.
        """
        rounds = self._beginnings(0, starts, roofs)
        if not rounds:
            return None
        log_posteriors = np.full(len(starts), -np.inf)
        ranges = range_log_densities(self._context.query, self._context.city_map, starts)
        for k in sorted(rounds, key=lambda k: -(rounds[k].log_posterior() + ranges[k]))[:_NUM_FOLLOWED]:
            rounds[k] = self._maximized(0, rounds[k])
            log_posteriors[k] = rounds[k].log_posterior() + ranges[k]
        best = rounds[int(log_posteriors.argmax())]
        return self._through_rounds(1, best, roofs, log_posteriors)

    def from_aligned(
        self, other: LineAlignment, roofs: RaisedRoofs, is_far: bool = False
    ) -> LineAlignment | None:
        """Returns the alignment from the end of another one; None without lines in view.

        Args:
            other: an alignment under another prior, or without lines at bases.
            roofs: the map without offsets.
            is_far: whether the vector may move by metres: through all rounds, not the last alone.
        """
        first = 0 if is_far else len(_ROUNDS) - 1
        return self._through_rounds(first, other, roofs, other.log_posteriors)

    def _through_rounds(
        self, first: int, start: _Round | LineAlignment, roofs: RaisedRoofs, log_posteriors: Floats
    ) -> LineAlignment | None:
        """Returns the alignment after the rounds from ``first`` on."""
        vector, line_likelihood = start.vector, start.line_likelihood
        for number in range(first, len(_ROUNDS)):
            base_and_overhang_m = float(vector[ALL_BASES]), float(vector[ALL_OVERHANGS])
            own_m = line_likelihood.building_roof_offsets_m(vector)
            roofs = roofs.with_offsets(own_m, *base_and_overhang_m)
            rounds = self._beginnings(number, vector[None], roofs)
            if not rounds:
                return None
            vector, line_likelihood, regions, _ = self._maximized(number, rounds[0])
        sharpness = line_likelihood.sharpness(vector)
        return LineAlignment(vector, line_likelihood, regions, sharpness, log_posteriors)

    def _beginnings(self, number: int, starts: Floats, roofs: RaisedRoofs) -> dict[int, _Round]:
        """Returns the beginnings of a round by index of its (M, 10) starts, of those with lines in view."""
        blur_px, spacing_px = _ROUNDS[number]
        levels, query = self._context.photo.levels(blur_px), self._context.query
        regions = StatePosterior(query, roofs, self._fit, self._params)

        def begin(start: Floats) -> _Round | None:
            lines = LineLikelihood(levels, query, roofs, start, self._params, self._has_bases)
            prior, posterior = regions.prior_information(_MOST_SIGMA_M), regions.of_poses(start[ALL_ROOFS])
            outlined = start[:NUM_WITH_BASES]
            initial = self._context.outlines.initial_gaussian(outlined, posterior, spacing_px, prior)
            return _Round(start, lines, regions, initial) if len(lines) and initial is not None else None

        # The first start alone: it prepares what all share.
        first = [begin(start) for start in starts[:1]]
        rounds = dict(enumerate([*first, *roofs.parallel_map(begin, list(starts[1:]))]))
        return {k: each for k, each in rounds.items() if each is not None}

    def _maximized(self, number: int, start: _Round) -> _Round:
        """Returns the end of a round: the maximum of the posterior near its beginning."""
        vector, lines, regions, initial = start
        log_likelihood = partial(_log_likelihood, lines, regions) if number == len(_ROUNDS) - 1 else lines

        def log_posterior(vectors: Floats) -> Floats:
            return log_likelihood(vectors) + regions.log_prior(vectors)

        covariance = regions.with_prior_of_rest(initial.covariance, _MOST_SIGMA_M)
        first, generator = Gaussian(vector, covariance), self._streams("lines", number)
        end = maximize(log_posterior, first, _GENERATIONS, self._params.population, generator)
        return start._replace(vector=end.mean)
