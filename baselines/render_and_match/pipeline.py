"""Render views of the map around a pose, match the photo with them, lift the matches, solve for the pose."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import lru_cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.geometry import Camera, Pose
from lodbench.matching.pose_solver import PoseSolver, SolvedPose, open_pose_solver
from lodbench.matching.protocol import Retrieval, open_retrieval
from lodbench.methods import Estimate, Input, Streams
from lodbench.segmentation.masks import read_photo

from .correspondences import CorrespondenceFinder, Correspondences, Matched, Oracle, opened_matching
from .params import ORACLE, RenderAndMatchParams
from .retrieval import places_over, retrieved
from .view import View, canvas_camera, views_near

Floats = NDArray[np.float64]

# A match this far off at most speaks for a pose, where nothing was measured; pixels.
_THRESHOLD_PX = 8.0


class RenderAndMatch(ABC):
    """Localises by matching a photo with rendered views; what a view shows is the subclass's business.

    Its score is the number of matches that the pose explains.

    Attributes:
        thresholds_px: By matcher, what ``params.threshold_px`` is where it is not given.
    """

    params_type: ClassVar[type[RenderAndMatchParams]]
    name: ClassVar[str]
    requires: frozenset[Input] = frozenset({Input.IMAGE})
    thresholds_px: ClassVar[Mapping[str, float]] = MappingProxyType({})

    def __init__(self, params: RenderAndMatchParams) -> None:
        self.params = params
        if params.matcher == ORACLE:
            unused = frozenset() if params.retrieval else {Input.IMAGE}
            self.requires = (self.requires - unused) | {Input.TRUE_PIXELS}

    def weight_files(self) -> list[Path]:
        """Returns the files of the matcher's and its extractor's weights.

        Raises:
            ConfigError: They are not there: told before any work.
        """
        parts: list[Any] = []
        if self.params.matcher != ORACLE:
            parts += opened_matching(self.params.matcher, self.params.weights)
        if self.params.retrieval is not None:
            parts.append(opened_retrieval(self.params.retrieval))
        return [file for part in parts for file in getattr(part, "weight_files", list)()]

    @abstractmethod
    def draw(
        self, city_map: CityMap, camera: Camera, rotations: Floats, centers: Floats
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Returns (N, H, W, 3) RGB pictures of N views and their (N, H, W) depths; 0 for none."""

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the pose that most matches agree on.

        Raises:
            QueryFault: The photo cannot be read, or no pose explains enough matches.
        """
        started = time.perf_counter()
        width = min(self.params.width, query.camera.width)
        camera = query.camera.scaled(width, max(1, round(width * query.camera.height / query.camera.width)))
        finder: CorrespondenceFinder
        if self.params.matcher == ORACLE:
            finder = Oracle(query, camera, self.params, streams("oracle", 0))
        else:
            finder = Matched(query, camera, self.params.matcher, self.params.weights)
        seconds = {"photo": time.perf_counter() - started}
        scale = width / self.params.width
        limit_px = self.params.threshold_px or self.thresholds_px.get(self.params.matcher, _THRESHOLD_PX)
        solver = open_pose_solver(self.params.pnp, threshold_px=limit_px * scale)
        best = self._solved(
            query,
            camera,
            finder,
            solver,
            self._views(self._starts(query, city_map, camera), city_map, camera),
        )
        seconds["first round"] = time.perf_counter() - started - seconds["photo"]
        trace = [float(best.inliers.sum())]
        for _ in range(1, self.params.rounds):
            try:
                solved = self._solved(
                    query, camera, finder, solver, self._views([best.pose], city_map, camera)
                )
            except QueryFault:
                break
            trace.append(float(solved.inliers.sum()))
            if trace[-1] <= trace[-2]:
                break
            best = solved
        seconds["further rounds"] = time.perf_counter() - started - sum(seconds.values())
        return Estimate(
            best.pose, float(best.inliers.sum()), seconds=seconds, trace={"inliers": tuple(trace)}
        )

    def _starts(self, query: Query, city_map: CityMap, camera: Camera) -> list[Pose]:
        """Returns the first round's poses: around the prior, or looked up over an area.

        Raises:
            QueryFault: There is no photo, or no view over the area sees the map.
        """
        params = self.params
        if params.retrieval is None:
            return views_near(query.prior, params.views, params.spread_m)
        if query.image is None:
            raise QueryFault("there is no photo")
        area_m = np.inf if params.area_m is None else params.area_m
        places = places_over(city_map.scene, query.prior.center, area_m, params.spacing_m)
        return retrieved(
            read_photo(query.image),
            query.prior,
            camera,
            places,
            partial(self.draw, city_map),
            opened_retrieval(params.retrieval),
            params.views,
        )

    def _views(self, poses: list[Pose], city_map: CityMap, camera: Camera) -> list[View]:
        wide = canvas_camera(camera, self.params.canvas)
        rotations = np.stack([each.rotation for each in poses])
        centers = np.stack([each.center for each in poses])
        pictures, depths = self.draw(city_map, wide, rotations, centers)
        return [View(wide, *view) for view in zip(poses, pictures, depths, strict=True)]

    def _solved(
        self,
        query: Query,
        camera: Camera,
        finder: CorrespondenceFinder,
        solver: PoseSolver,
        views: list[View],
    ) -> SolvedPose:
        """Returns the pose that the matches with some views agree on.

        Raises:
            QueryFault: There is none.
        """
        if not any(view.depth.any() for view in views):
            raise QueryFault("no building is in view from the prior")
        correspondences = [finder.with_view(view) for view in views]
        joined = Correspondences(
            np.concatenate([each.points for each in correspondences]),
            np.concatenate([each.pixels for each in correspondences]),
            sum(each.matched for each in correspondences),
        )
        if len(joined.points) < self.params.min_inliers:
            raise QueryFault(
                f"{joined.matched} matches, {len(joined.points)} of them where the map has a depth: "
                f"fewer than {self.params.min_inliers}"
            )
        solved = solver.solve(joined.points, joined.pixels, camera, query.prior)
        agreed = 0 if solved is None else int(solved.inliers.sum())
        if solved is None or agreed < self.params.min_inliers:
            raise QueryFault(f"{agreed} of {len(joined.points)} matches agree on a pose")
        return solved


@lru_cache(maxsize=2)
def opened_retrieval(name: str) -> Retrieval:
    """Returns a retrieval, opened once in a process: it may hold a network."""
    return open_retrieval(name)
