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
from lodbench.estimation.outline import edges_of, scene_in_reach
from lodbench.estimation.posterior import shares_of
from lodbench.estimation.state_vector import TILT, TRUSTED, beyond_range, probability_within
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.protocol import Estimate, Streams
from lodbench.methods.region.answer import Answer, PoseFinalizer
from lodbench.methods.region.evidence import Photo, PosePosterior
from lodbench.methods.region.line_alignment import BLURS_PX
from lodbench.methods.region.line_likelihood import line_starts
from lodbench.methods.region.params import RegionParams
from lodbench.methods.region.roofs import RaisedRoofs
from lodbench.methods.region.search import (
    OutlineJacobian,
    Problem,
    grid_starts,
    modes_at,
    refine_candidates,
    rescore,
)
from lodbench.methods.region.trust import SIGNS_STAGE, ConfidenceFeatures, success_probability
from lodbench.methods.search import photo_edges, query_photo

Floats = NDArray[np.float64]

# Edges that are likelier than background by fewer nats may lie there by chance.
_LEAST_EVIDENCE = 10.0
# So many half widths from the prior's tilt, the photo has overruled it (docs/adr/0012, point 8).
_OVERRULED = 2.0
# A lens so many deviations from the declared one is worth a note.
_NEWS = 3.0
# Modes lower by so many nats after a few generations of refinement are given up: of those that 44 answers
# came from one was, and a third of all are (docs/adr/0011, point 10).
_PRUNE_BELOW_NATS = 100.0


class Region:
    """Finds the pose whose silhouette splits the photo into two regions that look most unlike each other."""

    params_type = RegionParams
    name = "region"
    requires = frozenset({Input.IMAGE})

    def __init__(self, params: RegionParams | None = None) -> None:
        self.params = params or RegionParams()

    def params_for_prior(self, prior: UniformPrior) -> RegionParams:
        """Returns the parameters that search all that such a prior leaves open, tilt included."""
        return self.params.for_prior(prior)

    def params_for_true_tilt(self) -> RegionParams:
        """Returns the parameters for priors of the true pitch and roll: a range of 0 holds them."""
        return replace(self.params, range_tilt_deg=0.0)

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the mean of the poses around the most probable one, weighed by photo and prior.

        Where that is not to be trusted, a second search begins from more samples (docs/adr/0011, point 7),
        and from where the map's lines lie along edges (point 8). Edges of roofs refine it (point 11).

        Raises:
            QueryFault: There is no photo, it cannot be decoded, or it fits no view of the map.
        """
        params = self.params.with_lens(query.lens_percent).over_measured(query.measured)
        problem = _problem(query, city_map, params)
        first = _searched(problem, params, streams)
        if first.probability >= TRUSTED or params.more_starts == 1:
            return _refined_by_edges(first, problem, params)

        def other_streams(stage: str, step: int) -> np.random.Generator:
            return streams(f"{stage} again", step)

        second = _searched(problem, params.with_more_starts(), other_streams, by_lines=True)
        best = max(first, second, key=lambda answer: answer.probability)
        spent, more = first.estimate.seconds, second.estimate.seconds
        seconds = {stage: spent[stage] + taken for stage, taken in more.items()}
        best = best._replace(estimate=replace(best.estimate, seconds=seconds))
        return _refined_by_edges(best, problem, params)


def _problem(query: Query, city_map: CityMap, params: RegionParams) -> Problem:
    photo = Photo(query_photo(query), query.camera, params, city_map.threads, BLURS_PX)
    # The rest of the city, however large, is looked at this once.
    part = scene_in_reach(city_map.scene, query.camera, query.prior, *params.reach())
    jacobian = OutlineJacobian(edges_of(part), city_map, params)
    return Problem(query, photo, city_map, RaisedRoofs(city_map, part, params.pitched_lower_m), jacobian)


class _Candidate(NamedTuple):
    """An answer, and what its probability comes from.

    Attributes:
        estimate: The answer.
        features: Of the trust model.
        share: Of the posterior that its mode has.
        is_lens_overruled: Whether the photo shows another focal length than declared.
    """

    estimate: Estimate
    features: ConfidenceFeatures
    share: float
    is_lens_overruled: bool

    @property
    def probability(self) -> float:
        return self.estimate.probability or 0.0


def _searched(problem: Problem, params: RegionParams, streams: Streams, by_lines: bool = False) -> _Candidate:
    """Returns the answer that one search leads to; its starts come from regions, or from lines as well."""
    started, query, jacobian = time.perf_counter(), problem.query, problem.jacobian
    coarse = problem.posterior(params, params.coarse_width, is_coarse=True)
    starts, best_fit = grid_starts(query, coarse, params)
    candidates = refine_candidates(
        starts, coarse, jacobian, params.coarse_generations, params.coarse_spread_px, streams
    )
    searched = time.perf_counter()
    fine = problem.posterior(params, params.fine_width, is_coarse=False)
    means = np.array([mode.gaussian.mean for mode in candidates[: params.modes]])
    modes = refine_candidates(
        means, fine, jacobian, params.fine_generations, params.fine_spread_px, streams, _PRUNE_BELOW_NATS
    )
    if by_lines and params.lines_weight > 0:
        modes += modes_at(line_starts(problem, fine, params, streams), fine)
    if not modes:
        raise QueryFault("no outline of a building is in view of any pose that fits")
    by_edges = fine.with_edges(params.judging_edge_weight)
    modes = problem.weighed_by_range(rescore(modes, by_edges))
    answer = PoseFinalizer(problem, params).answer(modes, streams)
    ranked = [k for k in np.argsort(-answer.evidence, kind="stable") if np.isfinite(answer.evidence[k])]
    best, *others = (modes[k].gaussian.mean for k in ranked)
    features = _confidence_features(answer, by_edges, best, params)
    share = float(shares_of(answer.evidence).max())
    out_of_range = beyond_range(
        fine.prior.offsets(answer.vector), answer.if_map_is_right, params.half_widths()
    )
    estimate = Estimate(
        pose=pose_from_vector(answer.vector),
        score=float(fine.fits(answer.vector[None])[0]),
        seconds={"coarse": searched - started, "fine": time.perf_counter() - searched},
        trace={
            "coarse": (best_fit,),
            "evidence [nats]": tuple(answer.evidence[ranked]),
            SIGNS_STAGE: tuple(features),
        },
        covariance=answer.covariance,
        probability=share * success_probability(features),
        alternatives=tuple(pose_from_vector(other) for other in others),
        notes=(*_lens_notes(answer.lens_percent, params), *out_of_range),
    )
    return _Candidate(estimate, features, share, _is_overruled(answer.lens_percent, params))


def _confidence_features(
    answer: Answer, posterior: PosePosterior, mode: Floats, params: RegionParams
) -> ConfidenceFeatures:
    """Returns the trust model's features of an answer, which comes from a mode of the search, (6,)."""
    beyond = float(abs(posterior.prior.offsets(mode)[2]) / params.half_widths()[2]) - 1.0
    return ConfidenceFeatures(
        probability_within(answer.if_map_is_right, answer.vector),
        answer.apart_m,
        answer.lines,
        answer.sharpness,
        max(0.0, beyond),
    )


def _lens_notes(percent: float, params: RegionParams) -> tuple[str, ...]:
    """Returns a sentence on a lens that is plainly not as declared, or nothing."""
    if not _is_overruled(percent, params):
        return ()
    longer = "longer" if percent > 0 else "shorter"
    return (f"the focal length was estimated {abs(percent):.1f} % {longer} than stated",)


def _is_overruled(percent: float, params: RegionParams) -> bool:
    return abs(percent) >= _NEWS * params.lens_percent


def _refined_by_edges(found: _Candidate, problem: Problem, params: RegionParams) -> Estimate:
    """Returns an answer refined by the edges of roofs where these are surer, as probable as that makes it.

    They are laid with the declared lens: an answer with another one stays.
    """
    estimate, started = found.estimate, time.perf_counter()
    if not params.edges or estimate.covariance is None or found.is_lens_overruled:
        return estimate
    answer = vector_from_pose(estimate.pose), estimate.covariance
    refined = _edge_alignment(*answer, problem.query, problem.city_map, params)
    if refined is not None:
        within = max(found.features.probability, probability_within(refined.covariance, refined.vector))
        probability = found.share * success_probability(found.features._replace(probability=within))
        estimate = replace(
            estimate,
            pose=pose_from_vector(refined.vector),
            covariance=refined.covariance,
            probability=probability,
        )
    return replace(estimate, seconds=estimate.seconds | {"edges": time.perf_counter() - started})


def _edge_alignment(
    vector: Floats, covariance: Floats, query: Query, city_map: CityMap, params: RegionParams
) -> EdgeAlignment | None:
    """Returns where the edges of roofs have an answer, (6,); None where they are no surer of the place.

    Eq. (R24) of docs/methods/region.md.

    Edges have to be likelier there, plainly likelier than background, and leave the smaller variance; the
    answer's tilt must not have overruled the prior's.
    """
    half_widths, prior = np.array(params.half_widths()), vector_from_pose(query.prior)
    if np.any(np.abs(vector - prior)[TILT] > _OVERRULED * half_widths[TILT]):
        return None
    k1 = 0.0 if query.camera_sigmas is None else query.camera_sigmas.k1
    of_prior = half_widths / np.sqrt(3.0)
    if query.measured is not None:
        of_prior = query.measured.over(of_prior)
    sigmas = np.array([*of_prior, 0.01 * params.lens_percent, k1, 0.0, 0.0])
    edges = photo_edges(query)
    if edges is None:
        return None
    found = EdgeLikelihood(edges, query.camera, city_map, prior, sigmas).refined(vector)
    if found is None or found.gain <= 0.0 or found.evidence < _LEAST_EVIDENCE:
        return None
    return found if np.trace(found.covariance[:3, :3]) < np.trace(covariance[:3, :3]) else None
