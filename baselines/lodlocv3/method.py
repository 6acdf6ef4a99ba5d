"""LoD-Loc v3: LoD-Loc v2's grid and particle filter, ranked by buildings one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.geometry import rotations_at_yaws
from lodbench.methods import Estimate, Input, Streams
from lodbench.methods.fits import Particles, PoseScorer, Scoring, fit_input
from lodbench.methods.lodlocv2 import search

from .instance_fit import InstanceFit
from .params import LodLocV3Params

Floats = NDArray[np.float64]

# Views drawn at a time.
_BATCH = 64


class InstanceScorer:
    """Scores poses of the prior's tilt against the photo's buildings at one working size."""

    def __init__(
        self, query: Query, city_map: CityMap, size: tuple[int, int], weights: str, masks: NDArray[np.bool_]
    ) -> None:
        self._camera = query.camera.scaled(*size)
        self._pitch_deg, self._roll_deg, _ = query.prior.euler
        self._city_map = city_map
        self._fit = InstanceFit(masks, self._camera, weights)

    def __call__(self, centers: Floats, yaws_deg: Floats) -> Particles:
        """Returns the poses with their scores."""
        rotations = rotations_at_yaws(self._pitch_deg, self._roll_deg, yaws_deg)
        scores = np.empty(len(centers))
        for start in range(0, len(centers), _BATCH):
            batch = slice(start, start + _BATCH)
            scores[batch] = self._fit(
                self._city_map.buildings(self._camera, rotations[batch], centers[batch])
            )
        return Particles(centers, yaws_deg, scores)


class LodLocV3:
    """Pitch and roll stay the prior's, as LoD-Loc v2's."""

    params_type = LodLocV3Params
    name = "lodlocv3"
    requires: frozenset[Input] = frozenset({Input.INSTANCES})

    def __init__(self, params: LodLocV3Params | None = None) -> None:
        self.params = params or LodLocV3Params()
        if self.params.by_silhouette:
            # A mask of all buildings follows from those of each.
            self.requires = self.requires | {fit_input(self.params.fit)} - {Input.MASK}

    def params_for_prior(self, prior: UniformPrior) -> LodLocV3Params:
        """Returns the parameters whose grid covers such a prior's error."""
        params = self.params.for_prior(prior)
        if not isinstance(params, LodLocV3Params):
            raise TypeError(type(params))
        return params

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the pose whose buildings fit the photo's best.

        Raises:
            QueryFault: No building is told apart in the photo, or none of the map fits any.
        """
        masks = query.instances
        if masks is None:
            raise QueryFault("there are no masks of buildings")

        params = self.params
        whole = replace(query, building_probability=np.asarray(masks.any(axis=0), np.float32))

        def scorer_at(size: tuple[int, int]) -> Scoring:
            if params.by_silhouette and size == params.coarse_size:
                return PoseScorer(whole, city_map, size, params.fit)
            return InstanceScorer(query, city_map, size, params.weights, masks)

        estimate = search(scorer_at, query.prior, params, streams)
        if estimate.score <= 0:
            raise QueryFault("no hypothesis overlaps a building: the prior may be far from the city")
        return estimate
