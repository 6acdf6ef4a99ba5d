"""MC-Loc: LoD-Loc v2's grid and particle filter, ranked by features of photo and render instead of masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.geometry import rotations_at_yaws
from lodbench.methods import Estimate, Input, Streams
from lodbench.methods.fits import Particles
from lodbench.methods.lodlocv2 import search
from lodbench.segmentation.masks import read_photo

from ..render_and_match import resized_photo, shaded_views
from .features import open_features, similarities
from .params import McLocParams

Floats = NDArray[np.float64]

# Views rendered, and shown to a network, at a time.
_BATCH = 16


class FeatureScorer:
    """Scores poses of the prior's tilt by how much their render resembles the photo, at one working size."""

    def __init__(
        self,
        query: Query,
        photo: NDArray[np.uint8],
        city_map: CityMap,
        size: tuple[int, int],
        params: McLocParams,
    ) -> None:
        self._camera = query.camera.scaled(*size)
        self._pitch_deg, self._roll_deg, _ = query.prior.euler
        self._city_map, self._is_textured = city_map, params.map == "textured"
        self._features = open_features(params.features, params.weights)
        self.sees_map = False
        self._photo = self._features(resized_photo(photo, self._camera)[None])[0]

    def __call__(self, centers: Floats, yaws_deg: Floats) -> Particles:
        """Returns the poses with their scores, each below 0."""
        rotations = rotations_at_yaws(self._pitch_deg, self._roll_deg, yaws_deg)
        scores = np.empty(len(centers))
        for start in range(0, len(centers), _BATCH):
            batch = slice(start, start + _BATCH)
            pictures = self._pictures(rotations[batch], centers[batch])
            self.sees_map = self.sees_map or bool(pictures.min() < pictures.max())
            scores[batch] = similarities(self._photo, self._features(pictures))
        return Particles(centers, yaws_deg, scores)

    def _pictures(self, rotations: Floats, centers: Floats) -> NDArray[np.uint8]:
        if self._is_textured:
            return self._city_map.colour(self._camera, rotations, centers)
        return shaded_views(self._city_map, self._camera, rotations, centers)


class McLoc:
    """Renders and compares; pitch and roll stay the prior's, as LoD-Loc v2's."""

    params_type = McLocParams
    name = "mcloc"
    requires: frozenset[Input] = frozenset({Input.IMAGE})

    def __init__(self, params: McLocParams | None = None) -> None:
        self.params = params or McLocParams()
        if self.params.map == "textured":
            self.requires = self.requires | {Input.TEXTURED_MAP}

    def weight_files(self) -> list[Path]:
        """Returns the files of the features' weights.

        Raises:
            ConfigError: They are not there: told before any work.
        """
        return open_features(self.params.features, self.params.weights).weight_files()

    def params_for_prior(self, prior: UniformPrior) -> McLocParams:
        """Returns the parameters whose grid covers such a prior's error."""
        params = self.params.for_prior(prior)
        if not isinstance(params, McLocParams):
            raise TypeError(type(params))
        return params

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the pose whose render resembles the photo most.

        Raises:
            QueryFault: The photo is missing or of one colour, or no pose looked at sees the map.
        """
        if query.image is None:
            raise QueryFault("there is no photo")
        photo = read_photo(query.image)
        if (photo == photo[:1, :1]).all():
            raise QueryFault("the photo has one colour")

        scorers: list[FeatureScorer] = []

        def scorer_at(size: tuple[int, int]) -> FeatureScorer:
            if scorers and not scorers[-1].sees_map:
                raise QueryFault("no pose of the grid sees the map: the prior may be far from the city")
            scorers.append(FeatureScorer(query, photo, city_map, size, self.params))
            return scorers[-1]

        estimate = search(scorer_at, query.prior, self.params, streams)
        if not scorers[-1].sees_map:
            raise QueryFault("no pose looked at sees the map: the prior may be far from the city")
        return estimate
