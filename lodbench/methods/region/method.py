"""The method: a pose from a photo's pixels, without a mask and without a network."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.estimation.edge_alignment import EdgeAlignment, EdgeLikelihood
from lodbench.estimation.outline_alignment import edges_of, scene_in_reach
from lodbench.estimation.posterior import mode_probabilities
from lodbench.estimation.state_vector import TILT, TRUSTED, beyond_range, probability_within
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.fits import photo_edges, query_photo
from lodbench.methods.protocol import Estimate, Streams
from lodbench.methods.region import posteriors
from lodbench.methods.region.answer import BLURS_PX, Answer, PoseFinalizer
from lodbench.methods.region.line_likelihood import line_starts
from lodbench.methods.region.params import RegionParams
from lodbench.methods.region.roofs import RaisedRoofs
from lodbench.methods.region.trust import CONFIDENCE_STAGE, ConfidenceFeatures, success_probability

Floats = NDArray[np.float64]

# The least log-ratio of roof edges to background that is not chance, nats.
_LEAST_EDGE_NATS = 10.0
# The largest tilt from the prior's at which roof edges are used, half widths of its range: beyond, the photo
# contradicts the declared range (docs/adr/0012, point 8).
_MAX_TILT_HALF_WIDTHS = 2.0
# The least error of the focal length that counts as a wrong declaration, standard deviations.
_WRONG_FOCAL_SIGMAS = 3.0
# Refinements whose log-posterior is lower than the best by more after four generations end, nats: one of the
# modes that 44 answers came from was one of these, and a third of all are (docs/adr/0011, point 10).
_PRUNE_BELOW_NATS = 100.0


class Region:
    """Estimates the posterior's mean near the best mode by a photo's regions, lines and edges."""

    params_type = RegionParams
    name = "region"
    requires = frozenset({Input.IMAGE})

    def __init__(self, params: RegionParams | None = None) -> None:
        self.params = params or RegionParams()

    def params_for_prior(self, prior: UniformPrior) -> RegionParams:
        """Returns the parameters whose search covers the range of a prior, tilt included."""
        return self.params.for_prior(prior)

    def params_for_true_tilt(self) -> RegionParams:
        """Returns the parameters for priors with the true pitch and roll: their range is 0."""
        return replace(self.params, range_tilt_deg=0.0)

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the mean of the posterior near its best mode, with covariance and probability.

        If its probability is below one half, a second search starts from more poses (docs/adr/0011, point 7),
        and from those at which lines lie along edges (point 8). Roof edges refine the answer (point 11).

        Raises:
            QueryFault: There is no photo, it cannot be decoded, or it fits no view of the map.
        """
        params = self.params.with_lens(query.lens_percent).over_measured(query.measured)
        context = _query_context(query, city_map, params)
        first = _search(context, params, streams)
        if first.probability >= TRUSTED or params.more_starts == 1:
            return _refine_by_edges(first, context, params)

        def other_streams(stage: str, step: int) -> np.random.Generator:
            return streams(f"{stage} again", step)

        second = _search(context, params.with_more_starts(), other_streams, by_lines=True)
        best = max(first, second, key=lambda answer: answer.probability)
        spent, more = first.estimate.seconds, second.estimate.seconds
        seconds = {stage: spent[stage] + taken for stage, taken in more.items()}
        best = best._replace(estimate=replace(best.estimate, seconds=seconds))
        return _refine_by_edges(best, context, params)


def _query_context(query: Query, city_map: CityMap, params: RegionParams) -> posteriors.QueryContext:
    photo = posteriors.Photo(query_photo(query), query.camera, params, city_map.threads, BLURS_PX)
    # The only step whose cost depends on the size of the city.
    part = scene_in_reach(city_map.scene, query.camera, query.prior, *params.reach())
    outlines = posteriors.OutlineSampler(edges_of(part), city_map, params)
    return posteriors.QueryContext(
        query, photo, city_map, RaisedRoofs(city_map, part, params.pitched_lower_m), outlines
    )


class _Candidate(NamedTuple):
    """The answer of one search."""

    estimate: Estimate  # the answer
    features: ConfidenceFeatures  # features of the trust model
    mode_probability: float  # probability of its mode among the modes that were followed
    is_focal_wrong: bool  # whether the focal length is estimated clearly different from the declared one

    @property
    def probability(self) -> float:
        return self.estimate.probability or 0.0


def _search(
    context: posteriors.QueryContext, params: RegionParams, streams: Streams, by_lines: bool = False
) -> _Candidate:
    """Returns the answer of one search, which starts from regions, or from regions and lines."""
    started, query = time.perf_counter(), context.query
    coarse = context.posterior(params, params.coarse_width, is_coarse=True)
    starts, best_fit = posteriors.grid_starts(query, coarse, params)
    schedule = params.coarse_generations, params.coarse_spread_px
    candidates = posteriors.local_searches(starts, coarse, context.outlines, *schedule, streams)
    searched = time.perf_counter()
    fine = context.posterior(params, params.fine_width, is_coarse=False)
    modes = _refined_modes(candidates, context, fine, params, streams, by_lines)
    with_edges = fine.with_edges(params.judging_edge_weight)
    modes = context.with_laser_range(posteriors.rescore(modes, with_edges))
    answer = PoseFinalizer(context, params).answer(modes, streams)
    logs = answer.log_posteriors
    ranked = [k for k in np.argsort(-logs, kind="stable") if np.isfinite(logs[k])]
    best, *others = (modes[k].gaussian.mean for k in ranked)
    features = _confidence_features(answer, with_edges, best, params)
    mode_probability = float(mode_probabilities(logs).max())
    out_of_range = beyond_range(
        fine.prior.offsets(answer.vector), answer.covariance_if_map_is_right, params.half_widths()
    )
    estimate = Estimate(
        pose=pose_from_vector(answer.vector),
        score=float(fine.fits(answer.vector[None])[0]),
        seconds={"coarse": searched - started, "fine": time.perf_counter() - searched},
        trace={
            "coarse": (best_fit,),
            "evidence [nats]": tuple(logs[ranked]),
            CONFIDENCE_STAGE: tuple(features),
        },
        covariance=answer.covariance,
        probability=mode_probability * success_probability(features),
        alternatives=tuple(pose_from_vector(other) for other in others),
        notes=(*_focal_notes(answer.focal_error_percent, params), *out_of_range),
    )
    is_focal_wrong = _is_focal_wrong(answer.focal_error_percent, params)
    return _Candidate(estimate, features, mode_probability, is_focal_wrong)


def _refined_modes(
    candidates: list[posteriors.Mode],
    context: posteriors.QueryContext,
    fine: posteriors.PosePosterior,
    params: RegionParams,
    streams: Streams,
    by_lines: bool,
) -> list[posteriors.Mode]:
    """Returns the best candidates refined at the fine size, and if requested modes by lines."""
    means = np.array([mode.gaussian.mean for mode in candidates[: params.modes]])
    schedule = params.fine_generations, params.fine_spread_px
    modes = posteriors.local_searches(means, fine, context.outlines, *schedule, streams, _PRUNE_BELOW_NATS)
    if by_lines and params.lines_weight > 0:
        modes += posteriors.modes_at(line_starts(context, fine, params, streams), fine)
    if not modes:
        raise QueryFault("no outline of a building is in view of any pose that fits")
    return modes


def _confidence_features(
    answer: Answer, posterior: posteriors.PosePosterior, mode: Floats, params: RegionParams
) -> ConfidenceFeatures:
    """Returns the five features of the trust model, of an answer and its mode of the search, (6,)."""
    beyond = float(abs(posterior.prior.offsets(mode)[2]) / params.half_widths()[2]) - 1.0
    return ConfidenceFeatures(
        probability_within(answer.covariance_if_map_is_right, answer.vector),
        answer.apart_m,
        answer.line_log_ratio_nats,
        answer.sharpness,
        max(0.0, beyond),
    )


def _focal_notes(error_percent: float, params: RegionParams) -> tuple[str, ...]:
    """Returns a sentence on a focal length that is clearly not as declared, or nothing."""
    if not _is_focal_wrong(error_percent, params):
        return ()
    longer = "longer" if error_percent > 0 else "shorter"
    return (f"the focal length was estimated {abs(error_percent):.1f} % {longer} than stated",)


def _is_focal_wrong(error_percent: float, params: RegionParams) -> bool:
    return abs(error_percent) >= _WRONG_FOCAL_SIGMAS * params.lens_percent


def _refine_by_edges(
    candidate: _Candidate, context: posteriors.QueryContext, params: RegionParams
) -> Estimate:
    """Returns the estimate of a candidate, refined by roof edges if that has the smaller variance.

    Edges are compared at the declared focal length: a candidate with another one is returned unchanged.
    """
    estimate, started = candidate.estimate, time.perf_counter()
    if not params.edges or estimate.covariance is None or candidate.is_focal_wrong:
        return estimate
    answer = vector_from_pose(estimate.pose), estimate.covariance
    refined = _edge_alignment(*answer, context.query, context.city_map, params)
    if refined is not None:
        within = max(candidate.features.probability, probability_within(refined.covariance, refined.vector))
        features = candidate.features._replace(probability=within)
        estimate = replace(
            estimate,
            pose=pose_from_vector(refined.vector),
            covariance=refined.covariance,
            probability=candidate.mode_probability * success_probability(features),
        )
    return replace(estimate, seconds=estimate.seconds | {"edges": time.perf_counter() - started})


def _edge_alignment(
    vector: Floats, covariance: Floats, query: Query, city_map: CityMap, params: RegionParams
) -> EdgeAlignment | None:
    """Returns the alignment of roof edges near an answer, (6,), or None where the answer is kept.

    Eq. (R24) of docs/methods/region.md: edges have to be likelier at the new pose, clearly likelier than
    background, and leave the smaller variance; the answer's tilt must not contradict the declared range.
    """
    half_widths, prior = np.array(params.half_widths()), vector_from_pose(query.prior)
    if np.any(np.abs(vector - prior)[TILT] > _MAX_TILT_HALF_WIDTHS * half_widths[TILT]):
        return None
    k1 = 0.0 if query.camera_sigmas is None else query.camera_sigmas.k1
    prior_sigmas = half_widths / np.sqrt(3.0)
    if query.measured is not None:
        prior_sigmas = query.measured.over(prior_sigmas)
    sigmas = np.array([*prior_sigmas, 0.01 * params.lens_percent, k1, 0.0, 0.0])
    edges = photo_edges(query)
    if edges is None:
        return None
    aligned = EdgeLikelihood(edges, query.camera, city_map, prior, sigmas).refined(vector)
    if aligned is None or aligned.gain <= 0.0 or aligned.log_ratio_to_background < _LEAST_EDGE_NATS:
        return None
    return aligned if np.trace(aligned.covariance[:3, :3]) < np.trace(covariance[:3, :3]) else None
