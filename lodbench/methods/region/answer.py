"""The answer from the modes of the search: by lines, the mean of the posterior, its covariance.

The model's lines are aligned with the photo's edges in rounds; the height of each roof is estimated as well.
Lines also choose among the modes: regions mistake a lawn for a roof of the same size, but no edges lie along
its outline (docs/adr/0011, point 7).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeGuard

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap.laser import range_log_densities
from lodbench.estimation.optimization import maximize
from lodbench.estimation.posterior import covariance_under_map_errors, information_at, posterior_mean
from lodbench.estimation.state_vector import (
    ALL_BASES,
    ALL_OVERHANGS,
    ALL_ROOFS,
    FOCAL,
    NUM_AFTER_POSE,
    NUM_POSE,
    NUM_POSE_AND_FOCAL,
    NUM_WITH_BASES,
    NUM_WITH_ROOFS,
    POSE,
    TILT,
    Gaussian,
)
from lodbench.methods.protocol import Streams
from lodbench.methods.region.line_likelihood import LineLikelihood
from lodbench.methods.region.params import RegionParams
from lodbench.methods.region.posteriors import Mode, PhotoFit, QueryContext, StatePosterior
from lodbench.methods.region.roofs import RaisedRoofs
from lodbench.methods.region.trust import NO_LINES, TYPICAL_LINES, LineFeatures

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
    """A state vector at which the model's lines lie on the photo's edges."""

    vector: Floats  # (10,) the state vector
    line_likelihood: LineLikelihood  # likelihood of the edges near it
    region_posterior: StatePosterior  # posterior by regions, each roof drawn at its own height
    sharpness: float  # sharpness of the edges, as returned by ``LineLikelihood.sharpness``
    # (M,) log-posterior of each start by lines and regions, (R13), up to a constant; -inf for starts that
    # were not followed. The vector comes from the best.
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


# How far apart the outlines of the poses lie that the likelihood's information is fitted to, pixels of the
# fine size: farther than its steps of single pixels, within the mode.
_SPACING_PX = 1.5
# A wider tilt is tried where pitch or roll takes more than this fraction of the half width of its range.
_TILT_DOUBT_FRACTION = 0.7
# The standard deviation of focal lengths, percent, at which the trust model was fitted.
_FITTED_PERCENT = 0.2
# Lines at bases are used if they lower the log-posterior without them by less than this.
_MAX_LOSS_BY_BASES_NATS = 5.0
# From (N, 10) state vectors and a tempering exponent to the (N,) tempered log-likelihood.
LogLikelihood = Callable[[Floats, float], Floats]


class Answer(NamedTuple):
    """A pose, and the quantities that its probability depends on."""

    vector: Floats  # (6,) the mean of the posterior near the best mode, or near its alignment by lines
    covariance: Floats  # (6, 6) covariance of its error
    covariance_if_map_is_right: Floats  # (6, 6) the same if the map had no errors
    apart_m: float  # distance between the position by the model's lines and that of the search's mode, metres
    # Log-ratio of the photo's edges on the lines to edges anywhere; 0 without lines
    line_log_ratio_nats: float
    sharpness: float  # sharpness of the edges, as returned by ``LineLikelihood.sharpness``
    # (M,) log-posterior of each mode of the search, up to a constant: by lines and regions, or without lines
    # by regions and edges; -inf for modes that were not followed. The vector is near the best.
    log_posteriors: Floats
    # By how much the focal length is estimated longer than declared, percent
    focal_error_percent: float = 0.0


class PoseFinalizer:
    """Makes an answer from the modes of the search for one photo.

    Vectors of ten numbers are state vectors (``estimation.state_vector``).
    """

    def __init__(self, context: QueryContext, params: RegionParams) -> None:
        self._context, self._params = context, params
        self._roofs, self._outlines = context.roofs, context.outlines
        self._fit = context.photo.fit(params.fine_width, is_coarse=False)

    def answer(self, modes: list[Mode], streams: Streams) -> Answer:
        """Returns the answer near the best of some modes: by lines where edges on them are sharp enough.

        Args:
            modes: the modes of the search, best first by regions and edges; lines choose among them.
            streams: random streams.
        """
        params = self._params
        starts = np.array([np.append(mode.gaussian.mean, np.zeros(NUM_AFTER_POSE)) for mode in modes])
        by_search = np.array([mode.log_posterior for mode in modes])
        if params.lines_weight <= 0:
            return self._by_regions(starts[0], TYPICAL_LINES, by_search)
        aligned = self._best_aligned(starts, streams)
        if aligned is None:
            return self._by_regions(starts[0], NO_LINES, by_search)
        start = starts[int(aligned.log_posteriors.argmax())]
        apart_m = float(np.linalg.norm((aligned.vector - start)[:3]))
        log_ratio_nats = float(aligned.line_likelihood(aligned.vector[None])[0])
        features = LineFeatures(apart_m, log_ratio_nats, aligned.sharpness)
        if aligned.sharpness < params.least_sharpness:
            return self._by_regions(start, features, aligned.log_posteriors)
        posterior = aligned.region_posterior
        covariances = self._covariances(aligned.log_likelihood, aligned.vector, posterior)
        mean = self._mean(aligned.log_likelihood, aligned.vector, covariances[0], posterior)
        return Answer(mean[POSE], *covariances, *features, aligned.log_posteriors, float(mean[FOCAL]))

    def _best_aligned(self, starts: Floats, streams: Streams) -> LineAlignment | None:
        """Returns the alignment under the declared tilt and lens, or others where lines are clearly likelier.

        Lines at bases are used only as far as roofs, which nothing hides, do not contradict them
        (docs/adr/0012, point 6); another tilt only where the photo contradicts the declared one (point 8);
        another lens only over an exact map: elsewhere errors of roofs have the same effect (point 7).
        """
        params = self._params
        best = self._aligner(params, streams).from_best(starts, self._roofs)
        if best is None:
            return None
        with_bases = self._aligner(params, streams, has_bases=True).from_aligned(best, self._roofs)
        if with_bases is not None and best.worse_by(with_bases.vector) < _MAX_LOSS_BY_BASES_NATS:
            best = with_bases
        if self._is_tilt_doubtful(best):
            wide = replace(params, range_tilt_deg=2.0 * params.tilt_doubt_deg)
            other = self._aligner(wide, streams).from_aligned(best, self._roofs, is_far=True)
            if self._is_clearly_better(other, best):
                best, params = other, wide
        if params.lens_doubt_percent > params.lens_percent and best.sharpness >= params.least_sharpness:
            wide = replace(params, lens_percent=params.lens_doubt_percent)
            other = self._aligner(wide, streams).from_aligned(best, self._roofs)
            if self._is_clearly_better(other, best):
                best = other
        return best

    def _is_tilt_doubtful(self, aligned: LineAlignment) -> bool:
        """Returns whether pitch or roll is so near the end of its declared range that both may err more."""
        range_deg = self._params.range_tilt_deg
        if not 0.0 < range_deg < 2.0 * self._params.tilt_doubt_deg:
            return False
        prior = aligned.region_posterior.of_poses(0.0).prior
        tilt_deg = prior.offsets(aligned.vector[POSE])[TILT]
        return bool(np.abs(tilt_deg).max() > _TILT_DOUBT_FRACTION * 0.5 * range_deg)

    def _is_clearly_better(
        self, other: LineAlignment | None, best: LineAlignment
    ) -> TypeGuard[LineAlignment]:
        return other is not None and other.lead_over(best) >= self._params.doubt_nats

    def _aligner(self, params: RegionParams, streams: Streams, has_bases: bool = False) -> LineAligner:
        """Returns an aligner of lines with edges under the prior of some parameters."""
        # Edges are part of the lines' likelihood: that of regions has none.
        return LineAligner(self._context, self._fit.with_edges(0.0), params, streams, has_bases)

    def _by_regions(self, vector: Floats, features: LineFeatures, log_posteriors: Floats) -> Answer:
        """Returns the answer near (10,) by regions and edges, without lines, at ``mean_width``."""
        params, of_map = self._params, (self._context.query, self._roofs)
        fine = StatePosterior(*of_map, self._fit, params)
        covariances = self._covariances(_tempered(fine), vector, fine)
        if params.place_sigma_m <= 0:
            return Answer(vector[POSE], *covariances, *features, log_posteriors)
        finest = StatePosterior(*of_map, self._context.photo.fit(params.mean_width, False), params)
        mean = self._mean(_tempered(finest), vector, covariances[0], finest)
        return Answer(mean[POSE], *covariances, *features, log_posteriors)

    def _covariances(
        self, log_likelihood: LogLikelihood, vector: Floats, posterior: StatePosterior
    ) -> tuple[Floats, Floats]:
        """Returns the covariance (6, 6) of the error at (10,), and the same if the map had no errors."""
        pose, of_poses = vector[POSE], posterior.of_poses(float(vector[ALL_ROOFS]))

        def of_pose(poses: Floats) -> Floats:
            return log_likelihood(np.column_stack([poses, np.tile(vector[NUM_POSE:], (len(poses), 1))]), 1.0)

        near = self._outlines.initial_gaussian(pose, of_poses, _SPACING_PX)
        likelihood_information = np.zeros((6, 6)) if near is None else information_at(of_pose, near)
        prior, outline = of_poses.prior.information(), self._outlines.outline(pose, of_poses)
        lens_percent = self._params.lens_percent
        covariance = covariance_under_map_errors(likelihood_information, prior, outline, lens_percent)
        if_map_is_right = np.linalg.inv(likelihood_information + prior)
        if lens_percent > _FITTED_PERCENT:
            _, ridge = self._focal_ridge(vector, posterior)
            if_map_is_right += (lens_percent**2 - _FITTED_PERCENT**2) * np.outer(ridge[POSE], ridge[POSE])
        return covariance, np.asarray(if_map_is_right)

    def _mean(
        self, log_likelihood: LogLikelihood, vector: Floats, covariance: Floats, posterior: StatePosterior
    ) -> Floats:
        """Returns the posterior's mean near (10,), bases and overhangs fixed; (10,) for no least width."""
        least_m = self._params.place_sigma_m
        if least_m <= 0:
            return vector

        def states(vectors: Floats) -> Floats:
            return np.column_stack([vectors, np.tile(vector[NUM_WITH_ROOFS:], (len(vectors), 1))])

        proposal_covariance = posterior.with_prior_of_rest(self._with_focal(vector, covariance, posterior))
        return posterior_mean(
            lambda vectors, temper: log_likelihood(states(vectors), temper),
            lambda vectors: posterior.log_prior(states(vectors)),
            vector[:NUM_WITH_ROOFS],
            proposal_covariance[:NUM_WITH_ROOFS, :NUM_WITH_ROOFS],
            least_m,
        )

    def _with_focal(self, vector: Floats, covariance: Floats, posterior: StatePosterior) -> Floats:
        """Returns the covariance (7, 7) of pose and focal length at (10,), given that of the pose, (6, 6)."""
        variance, ridge = self._focal_ridge(vector, posterior)
        whole = variance * np.outer(ridge, ridge)
        whole[POSE, POSE] += covariance
        return np.asarray(whole)

    def _focal_ridge(self, vector: Floats, posterior: StatePosterior) -> tuple[float, Floats]:
        """Returns the variance of the focal length at (10,), and (7,) the mean change per percent of it."""
        of_poses, camera = posterior.of_poses(float(vector[ALL_ROOFS])), vector[:NUM_POSE_AND_FOCAL]
        prior = posterior.prior_information()[:NUM_POSE_AND_FOCAL, :NUM_POSE_AND_FOCAL]
        near = self._outlines.initial_gaussian(camera, of_poses, _SPACING_PX, prior)
        alone = np.eye(NUM_POSE_AND_FOCAL)[FOCAL] / prior[FOCAL, FOCAL]
        along = alone if near is None else near.covariance[:, FOCAL]
        return float(along[FOCAL]), along / along[FOCAL]


def _tempered(posterior: StatePosterior) -> LogLikelihood:
    return lambda vectors, temper: temper * posterior.log_likelihood(vectors)
