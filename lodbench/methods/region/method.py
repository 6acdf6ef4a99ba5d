"""The method: a pose from a photo's pixels, without a mask and without a network."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.methods.contour_alignment.outline import edges_in_reach, scene_in_reach
from lodbench.methods.contour_alignment.pose_vector import pose_from_vector
from lodbench.methods.contour_alignment.uncertainty import beyond_range, probability_within
from lodbench.methods.fits import query_photo
from lodbench.methods.protocol import Estimate, Streams
from lodbench.methods.region.answer import Answering
from lodbench.methods.region.evidence import Evidence, PhotoFit
from lodbench.methods.region.params import Params, working_size
from lodbench.methods.region.roofs import RaisedRoofs
from lodbench.methods.region.search import Surroundings, climbed, grid_starts, judged
from lodbench.methods.region.trust import Signs, trust_of
from lodbench.methods.region.uncertainty import share_of_best


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

        Raises:
            QueryFault: There is no photo, it cannot be decoded, or it fits no view of the map.
        """
        started = time.perf_counter()
        photo = query_photo(query)
        params = self.params
        # The rest of the city, however large, is looked at this once.
        part = scene_in_reach(city_map.scene, query.camera, query.prior, *_reach(params))
        edges = edges_in_reach(part, query.camera, query.prior, *_reach(params))
        around = Surroundings(edges, city_map, params)
        search = self._evidence(query, city_map, photo, params.coarse_width, is_coarse=True)
        starts, best = grid_starts(query, search, params)
        tops = climbed(starts, search, around, params.coarse_generations, params.coarse_spread_px, streams)
        searched = time.perf_counter()
        final = self._evidence(query, city_map, photo, params.fine_width, is_coarse=False)
        means = np.array([top.cloud.mean for top in tops[: params.modes]])
        modes = climbed(means, final, around, params.fine_generations, params.fine_spread_px, streams)
        if not modes:
            raise QueryFault("no outline of a building is in view of any pose that fits")
        judge = final.with_edges(params.judging_edge_weight)
        modes = judged(modes, judge)
        roofs = RaisedRoofs(city_map, part)
        answer = Answering(photo, query, roofs, around, params).answer(modes, streams)
        ranked = [k for k in np.argsort(-answer.evidence, kind="stable") if np.isfinite(answer.evidence[k])]
        modes = [modes[k] for k in ranked]
        top = modes[0].cloud.mean
        half_widths = params.half_widths()
        beyond = float(abs(final.offsets(top[None])[0, 2]) / half_widths[2]) - 1.0
        signs = Signs(
            probability_within(answer.if_map_is_right, answer.vector),
            answer.apart_m,
            answer.lines,
            float(judge.fits(top[None])[0]),
            max(0.0, beyond),
        )
        finished = time.perf_counter()
        return Estimate(
            pose=pose_from_vector(answer.vector),
            score=float(final.fits(answer.vector[None])[0]),
            seconds={"coarse": searched - started, "fine": finished - searched},
            trace={
                "coarse": (best,),
                "modes": tuple(answer.evidence[ranked]),
                "signs": tuple(signs),
            },
            covariance=answer.covariance,
            probability=share_of_best(answer.evidence) * trust_of(signs),
            alternatives=tuple(pose_from_vector(mode.cloud.mean) for mode in modes[1:]),
            notes=beyond_range(final.offsets(answer.vector[None])[0], answer.if_map_is_right, half_widths),
        )

    def _evidence(
        self, query: Query, city_map: CityMap, photo: NDArray[np.uint8], width: int, is_coarse: bool
    ) -> Evidence:
        size = working_size(query.camera, width)
        return Evidence(query, city_map, PhotoFit(photo, size, self.params, is_coarse), self.params)


def _reach(params: Params) -> tuple[float, float]:
    """Returns how far the camera may be from the prior, metres, and how far turned, degrees."""
    reach_m = math.hypot(params.range_x_m, params.range_y_m, params.range_z_m)
    return reach_m, params.range_yaw_deg + 2.0 * params.range_tilt_deg
