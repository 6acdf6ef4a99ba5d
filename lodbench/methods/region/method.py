"""The method: a pose from a photo's pixels, without a mask and without a network."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.geometry import Camera
from lodbench.methods.contour_alignment.outline import edges_in_reach
from lodbench.methods.contour_alignment.pose_vector import pose_from_vector
from lodbench.methods.contour_alignment.uncertainty import beyond_range, probability_within
from lodbench.methods.fits import query_photo
from lodbench.methods.protocol import Estimate, Streams
from lodbench.methods.region.averaging import posterior_mean
from lodbench.methods.region.evidence import Evidence, PhotoFit
from lodbench.methods.region.lines import aligned_by_lines
from lodbench.methods.region.map_errors import covariance_under_map_errors
from lodbench.methods.region.params import Params
from lodbench.methods.region.search import Surroundings, climbed, grid_starts, judged
from lodbench.methods.region.trust import NO_LINES, TYPICAL_LINES, Signs, trust_of
from lodbench.methods.region.uncertainty import information_at, share_of_best

Floats = NDArray[np.float64]


class _Chosen(NamedTuple):
    """The best pose, (6,), the likelihood that it is best by, and what the model's lines say of it."""

    vector: Floats
    nats: Callable[[Floats], Floats]
    is_by_lines: bool
    apart_m: float
    sharpness: float


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
        around = self._surroundings(query, city_map)
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
        chosen = self._on_lines(photo, query, city_map, modes[0].cloud.mean, final, around, streams)
        information = information_at(chosen.nats, chosen.vector, final, around)
        prior, outline = final.prior_information(), around.outline(chosen.vector, final)
        if_map_is_right: Floats = np.asarray(np.linalg.inv(information + prior))
        covariance = covariance_under_map_errors(information, prior, outline)
        half_widths = params.half_widths()
        signs = _signs(chosen, final, judge, if_map_is_right, half_widths)
        vector = self._mean(photo, query, city_map, chosen, final, covariance)
        finished = time.perf_counter()
        return Estimate(
            pose=pose_from_vector(vector),
            score=float(final.fits(vector[None])[0]),
            seconds={"coarse": searched - started, "fine": finished - searched},
            trace={
                "coarse": (best,),
                "modes": tuple(mode.log_posterior for mode in modes),
                "signs": tuple(signs),
            },
            covariance=covariance,
            probability=share_of_best(modes) * trust_of(signs),
            alternatives=tuple(pose_from_vector(mode.cloud.mean) for mode in modes[1:]),
            notes=beyond_range(final.offsets(vector[None])[0], if_map_is_right, half_widths),
        )

    def _surroundings(self, query: Query, city_map: CityMap) -> Surroundings:
        params = self.params
        reach_m = math.hypot(params.range_x_m, params.range_y_m, params.range_z_m)
        turn_deg = params.range_yaw_deg + 2.0 * params.range_tilt_deg
        edges = edges_in_reach(city_map.scene, query.camera, query.prior, reach_m, turn_deg)
        return Surroundings(edges, city_map, params)

    def _on_lines(
        self,
        photo: NDArray[np.uint8],
        query: Query,
        city_map: CityMap,
        vector: Floats,
        final: Evidence,
        around: Surroundings,
        streams: Streams,
    ) -> _Chosen:
        """Returns the pose by the model's lines where the photo shows the map to be exact, else the same."""
        if self.params.lines_weight <= 0:
            return _Chosen(vector, final.nats, False, *TYPICAL_LINES)
        # Lines say what edges say, and more: the regions join them without.
        regions = final.with_edges(0.0)
        lines = aligned_by_lines(photo, query, city_map, vector, regions, around, self.params, streams)
        if lines is None:
            return _Chosen(vector, final.nats, False, *NO_LINES)
        apart_m = float(np.linalg.norm((lines.vector - vector)[:3]))
        if lines.sharpness < self.params.least_sharpness:
            return _Chosen(vector, final.nats, False, apart_m, lines.sharpness)
        return _Chosen(lines.vector, lines.nats, True, apart_m, lines.sharpness)

    def _mean(
        self,
        photo: NDArray[np.uint8],
        query: Query,
        city_map: CityMap,
        chosen: _Chosen,
        final: Evidence,
        covariance: Floats,
    ) -> Floats:
        """Returns the mean of the poses around the best one, or that one where no mean is asked for."""
        params, nats = self.params, chosen.nats
        if params.mean_pixels <= 0:
            return chosen.vector
        if not chosen.is_by_lines:
            nats = self._evidence(query, city_map, photo, params.mean_width, is_coarse=False).nats
        return posterior_mean(nats, final.log_prior, params.mean_share(), chosen.vector, covariance)

    def _evidence(
        self, query: Query, city_map: CityMap, photo: NDArray[np.uint8], width: int, is_coarse: bool
    ) -> Evidence:
        size = _size(query.camera, width)
        return Evidence(query, city_map, PhotoFit(photo, size, self.params, is_coarse), self.params)


def _signs(
    chosen: _Chosen, final: Evidence, judge: Evidence, covariance: Floats, half_widths: Sequence[float]
) -> Signs:
    """Returns what says whether the best pose, not the mean, is the right one: its fit and its lines."""
    offset = final.offsets(chosen.vector[None])[0]
    return Signs(
        probability_within(covariance, chosen.vector),
        chosen.apart_m,
        chosen.sharpness,
        float(judge.fits(chosen.vector[None])[0]),
        max(0.0, float(abs(offset[2]) / half_widths[2]) - 1.0),
    )


def _size(camera: Camera, width: int) -> tuple[int, int]:
    """Returns a width and the height that keeps the photo's aspect; never more than the photo has."""
    width = min(width, camera.width)
    return width, max(1, round(width * camera.height / camera.width))
