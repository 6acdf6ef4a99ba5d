"""The method: a pose from a photo's pixels, without a mask and without a network."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.estimation.edge_alignment import EdgeAlignment, EdgeLikelihood
from lodbench.geometry.pose_vector import pose_from_vector, vector_from_pose
from lodbench.methods.contour_alignment.outline import edges_of, scene_in_reach
from lodbench.methods.contour_alignment.uncertainty import beyond_range, probability_within
from lodbench.methods.fits import query_photo
from lodbench.methods.protocol import Estimate, Streams
from lodbench.methods.region.aligned import BLURS_PX
from lodbench.methods.region.answer import Answer, PoseFinalizer
from lodbench.methods.region.evidence import Evidence, Photo
from lodbench.methods.region.lines import line_starts
from lodbench.methods.region.params import TILT, Params
from lodbench.methods.region.posterior import share_of_best
from lodbench.methods.region.roofs import RaisedRoofs
from lodbench.methods.region.search import OutlineJacobian, grid_starts, modes_of, refine_candidates, rescore
from lodbench.methods.region.trust import SIGNS_STAGE, TRUSTED, ConfidenceFeatures, success_probability

Floats = NDArray[np.float64]

# Edges that are likelier than background by fewer nats may lie there by chance.
_LEAST_EVIDENCE = 10.0
# So many half widths from the prior's tilt, the photo has overruled it (docs/adr/0064).
_OVERRULED = 2.0


def surer_by_edges(
    vector: Floats, covariance: Floats, query: Query, city_map: CityMap, params: Params
) -> EdgeAlignment | None:
    """Returns an answer refined by the edges of roofs, or None where these are no surer of the place.

    Eq. (R24) of docs/methods/region.md.

    Edges have to be likelier there, plainly likelier than background, and leave the smaller variance; the
    answer's tilt must not have overruled the prior's.

    Args:
        vector: (6,) the answer, metres and degrees.
        covariance: (6, 6) of its error.
        query: Whose photo it answers.
        city_map: The map.
        params: For the prior's width and the lens.
    """
    half_widths, prior = np.array(params.half_widths()), vector_from_pose(query.prior)
    if np.any(np.abs(vector - prior)[TILT] > _OVERRULED * half_widths[TILT]):
        return None
    k1 = 0.0 if query.camera_sigmas is None else query.camera_sigmas.k1
    sigmas = np.array([*half_widths / np.sqrt(3.0), 0.01 * params.lens_percent, k1, 0.0, 0.0])
    found = EdgeLikelihood(query_photo(query), query.camera, city_map, prior, sigmas).refined(vector)
    if found is None or found.gain <= 0.0 or found.evidence < _LEAST_EVIDENCE:
        return None
    return found if np.trace(found.covariance[:3, :3]) < np.trace(covariance[:3, :3]) else None


# A lens so many deviations from what is told is worth a note.
_NEWS = 3.0
# Tops lower by so many nats after a few generations of refinement are not followed: of those that 44 answers
# came from one was, and a third of all are (docs/adr/0066).
_PRUNE_BELOW_NATS = 100.0


class Region:
    """Finds the pose whose silhouette splits the photo into two regions that look most unlike each other."""

    params_type = Params
    name = "region"
    requires = frozenset({Input.IMAGE})

    def __init__(self, params: Params | None = None) -> None:
        self.params = params or Params()

    def params_for_prior(self, prior: UniformPrior) -> Params:
        """Returns the parameters that search all that such a prior leaves open, tilt included."""
        return self.params.for_prior(prior)

    def params_for_true_tilt(self) -> Params:
        """Returns the parameters for priors of the true pitch and roll: a range of 0 holds them."""
        return replace(self.params, range_tilt_deg=0.0)

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the mean of the poses around the most probable one, weighed by photo and prior.

        Where that is not to be trusted, a second search begins from more samples (docs/adr/0055), and from
        where the map's lines lie along edges (docs/adr/0057). Edges of roofs refine it (docs/adr/0070).

        Raises:
            QueryFault: There is no photo, it cannot be decoded, or it fits no view of the map.
        """
        params = self.params.with_lens(query.lens_percent)
        photo = Photo(query_photo(query), query.camera, params, city_map.threads, BLURS_PX)
        reach = _reach(params)
        # The rest of the city, however large, is looked at this once.
        part = scene_in_reach(city_map.scene, query.camera, query.prior, *reach)
        around = OutlineJacobian(edges_of(part), city_map, params)
        seen = _Seen(query, photo, city_map, RaisedRoofs(city_map, part, params.pitched_lower_m), around)
        found = _found(seen, params, streams)
        if _probability(found) >= TRUSTED or params.more_starts == 1:
            return _refined(found, seen, params)
        again = _found(
            seen,
            params.with_more_starts(),
            lambda stage, step: streams(f"{stage} again", step),
            by_lines=True,
        )
        best, first = max(found, again, key=_probability), found.estimate.seconds
        seconds = {stage: first[stage] + taken for stage, taken in again.estimate.seconds.items()}
        return _refined(best._replace(estimate=replace(best.estimate, seconds=seconds)), seen, params)


class _Found(NamedTuple):
    """An answer, and what its probability comes from.

    Attributes:
        estimate: The answer.
        features: That it is right.
        share: Of the evidence that its mode has.
        is_lens_overruled: Whether the photo shows another focal length than declared.
    """

    estimate: Estimate
    features: ConfidenceFeatures
    share: float
    is_lens_overruled: bool


class _Seen(NamedTuple):
    """A query and what there is to see of it.

    Attributes:
        query: The query.
        photo: Its photo.
        city_map: The map.
        roofs: The part of it in reach.
        around: How its outline moves.
    """

    query: Query
    photo: Photo
    city_map: CityMap
    roofs: RaisedRoofs
    around: OutlineJacobian

    def evidence(self, params: Params, width: int, is_coarse: bool) -> Evidence:
        """Returns what photo and prior say of poses, with silhouettes of a width, pixels."""
        return Evidence(self.query, self.city_map, self.photo.fit(width, is_coarse), params)


def _found(seen: _Seen, params: Params, streams: Streams, by_lines: bool = False) -> _Found:
    """Returns the answer that one search leads to, by regions or by the map's lines as well."""
    started, query, around = time.perf_counter(), seen.query, seen.around
    search = seen.evidence(params, params.coarse_width, is_coarse=True)
    starts, best = grid_starts(query, search, params)
    modes_found = refine_candidates(
        starts, search, around, params.coarse_generations, params.coarse_spread_px, streams
    )
    searched = time.perf_counter()
    final = seen.evidence(params, params.fine_width, is_coarse=False)
    means = np.array([top.cloud.mean for top in modes_found[: params.modes]])
    modes = refine_candidates(
        means, final, around, params.fine_generations, params.fine_spread_px, streams, _PRUNE_BELOW_NATS
    )
    if by_lines and params.lines_weight > 0:
        clouds = line_starts(seen.photo, query, seen.roofs, final, params, streams)
        modes += modes_of(clouds, final)
    if not modes:
        raise QueryFault("no outline of a building is in view of any pose that fits")
    judge = final.with_edges(params.judging_edge_weight)
    modes = rescore(modes, judge)
    answer = PoseFinalizer(seen.photo, query, seen.roofs, around, params).answer(modes, streams)
    ranked = [k for k in np.argsort(-answer.evidence, kind="stable") if np.isfinite(answer.evidence[k])]
    top, *others = (modes[k].cloud.mean for k in ranked)
    features = _confidence_features(answer, judge, top, params)
    share = share_of_best(answer.evidence)
    estimate = Estimate(
        pose=pose_from_vector(answer.vector),
        score=float(final.fits(answer.vector[None])[0]),
        seconds={"coarse": searched - started, "fine": time.perf_counter() - searched},
        trace={
            "coarse": (best,),
            "evidence [nats]": tuple(answer.evidence[ranked]),
            SIGNS_STAGE: tuple(features),
        },
        covariance=answer.covariance,
        probability=share * success_probability(features),
        alternatives=tuple(pose_from_vector(other) for other in others),
        notes=(
            *_lens_notes(answer.lens_percent, params),
            *beyond_range(
                final.offsets(answer.vector[None])[0], answer.if_map_is_right, params.half_widths()
            ),
        ),
    )
    return _Found(estimate, features, share, _is_overruled(answer.lens_percent, params))


def _refined(found: _Found, seen: _Seen, params: Params) -> Estimate:
    """Returns an answer refined by the edges of roofs where these are surer, as probable as that makes it.

    They are laid with the declared lens: an answer with another one stays.
    """
    estimate, started = found.estimate, time.perf_counter()
    if not params.edges or estimate.covariance is None or found.is_lens_overruled:
        return estimate
    vector = vector_from_pose(estimate.pose)
    surer = surer_by_edges(vector, estimate.covariance, seen.query, seen.city_map, params)
    if surer is not None:
        within = max(found.features.probability, probability_within(surer.covariance, surer.vector))
        probability = found.share * success_probability(found.features._replace(probability=within))
        estimate = replace(
            estimate,
            pose=pose_from_vector(surer.vector),
            covariance=surer.covariance,
            probability=probability,
        )
    return replace(estimate, seconds=estimate.seconds | {"edges": time.perf_counter() - started})


def _confidence_features(
    answer: Answer, judge: Evidence, top: NDArray[np.float64], params: Params
) -> ConfidenceFeatures:
    """Returns what tells whether an answer is right, which comes from a top of the search, (6,)."""
    beyond = float(abs(judge.offsets(top[None])[0, 2]) / params.half_widths()[2]) - 1.0
    return ConfidenceFeatures(
        probability_within(answer.if_map_is_right, answer.vector),
        answer.apart_m,
        answer.lines,
        answer.sharpness,
        max(0.0, beyond),
    )


def _lens_notes(percent: float, params: Params) -> tuple[str, ...]:
    """Returns a sentence on a lens that is plainly not as told, or nothing."""
    if not _is_overruled(percent, params):
        return ()
    longer = "longer" if percent > 0 else "shorter"
    return (f"the focal length was estimated {abs(percent):.1f} % {longer} than stated",)


def _is_overruled(percent: float, params: Params) -> bool:
    return abs(percent) >= _NEWS * params.lens_percent


def _probability(found: _Found) -> float:
    return found.estimate.probability or 0.0


def _reach(params: Params) -> tuple[float, float]:
    """Returns how far the camera may be from the prior, metres, and how far turned, degrees."""
    reach_m = math.hypot(params.range_x_m, params.range_y_m, params.range_z_m)
    return reach_m, params.range_yaw_deg + 2.0 * params.range_tilt_deg
