"""LoD-Loc (v1): the map's wireframe laid on a photo by a cost volume in three stages, then Gauss-Newton."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.geometry import Camera, Pose, PoseGrid
from lodbench.methods import Estimate, Input, Streams
from lodbench.segmentation.masks import read_photo
from lodbench.segmentation.probability import working_size

from .cost_volume import Stage, narrowed, search_grid, volume_scores
from .likelihood import Maps, maps_of, weights_file
from .params import LodLocParams
from .refinement import refined
from .training_params import LodLocTraining
from .wireframe import visible_points

Floats = NDArray[np.float64]
_SCALES = (0.25, 0.5, 1.0)
# A wireframe of fewer points is no town.
_LEAST_POINTS = 60
# Beyond a range by less than this is no news; and no sensor's pitch or roll errs by so much.
_MARGIN_M, _MARGIN_DEG, _MOST_TILT_DEG = 1.0, 0.5, 5.0


class LodLoc:
    """Wireframe alignment; pitch and roll are the prior's until the last step frees them."""

    params_type = LodLocParams
    training_type = LodLocTraining
    name = "lodloc"
    requires: frozenset[Input] = frozenset({Input.IMAGE})

    def __init__(self, params: LodLocParams | None = None) -> None:
        self.params = params or LodLocParams()

    def weight_files(self) -> list[Path]:
        """Returns the file of the network.

        Raises:
            ConfigError: It is not there: told before any work.
        """
        return [weights_file(self.params.weights)]

    def params_for_prior(self, prior: UniformPrior) -> LodLocParams:
        """Returns the parameters whose first stage covers such a prior's error."""
        return self.params.for_prior(prior)

    @staticmethod
    def train(settings: LodLocTraining, tell: Callable[[str], None]) -> Path:
        """Trains the network; returns the file that ``weights`` takes. See ``train_heads``."""
        from .training import train_heads

        return train_heads(settings, tell)

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the pose at which the map's wireframe fits the photo best.

        Raises:
            QueryFault: The photo is missing or of one colour, the prior sees no edges of the map, or they fit
                the photo nowhere.
        """
        if query.image is None:
            raise QueryFault("there is no photo")
        photo = read_photo(query.image)
        if (photo == photo[:1, :1]).all():
            raise QueryFault("the photo has one colour")
        started = time.perf_counter()
        camera = query.camera.scaled(*working_size(query.camera.width, query.camera.height, self.params.size))
        maps = maps_of(photo, camera.width, camera.height, self.params.weights)
        seconds = {"network": time.perf_counter() - started}
        alignment = _Alignment(maps, camera, city_map, self.params, streams)
        pose = query.prior
        for round_number in range(self.params.rounds):
            pose = alignment.improved(pose, round_number)
        seconds["alignment"] = time.perf_counter() - started - seconds["network"]
        score, least = alignment.trace[-1], self.params.least_score
        if score <= least:
            raise QueryFault(
                f"the map's edges fit the photo nowhere: {score:.1f} at best, not above {least:g}"
            )
        trace = {"stages": tuple(alignment.trace)}
        notes = beyond_range(pose, query.prior, self.params.grid())
        return Estimate(pose, score, seconds=seconds, trace=trace, notes=notes)


def beyond_range(pose: Pose, reference: Pose, grid: PoseGrid) -> tuple[str, ...]:
    """Returns a sentence for a pose beyond a grid around another, or leaning far from it, or nothing."""
    offsets = np.append(pose.center - reference.center, np.subtract(pose.euler, reference.euler))
    offsets[3:] = (offsets[3:] + 180.0) % 360.0 - 180.0
    widths = [axis.width for axis in (grid.x, grid.y, grid.z)]
    limits = [*(0.5 * width + _MARGIN_M for width in widths), _MOST_TILT_DEG, _MOST_TILT_DEG]
    limits.append(0.5 * grid.yaw.width + _MARGIN_DEG)
    names = ("x m", "y m", "z m", "pitch deg", "roll deg", "yaw deg")
    rows = zip(names, offsets.tolist(), limits, strict=True)
    out = [f"{name.split()[0]} {off:+.1f} {name.split()[1]}" for name, off, limit in rows if abs(off) > limit]
    if not out:
        return ()
    return (f"the pose lies outside the stated range of the prior: {', '.join(out)}",)


class _Alignment:
    """The search on one photo's maps."""

    def __init__(
        self, maps: Maps, camera: Camera, city_map: CityMap, params: LodLocParams, streams: Streams
    ) -> None:
        self._maps, self._camera, self._city_map = maps, camera, city_map
        self._params, self._streams = params, streams
        self._grid = params.grid()
        self.trace: list[float] = []

    def improved(self, pose: Pose, round_number: int) -> Pose:
        """Returns a better pose than the last one, by the wireframe that the last one sees."""
        points = self._wireframe(pose, round_number)
        grid = self._grid
        first = 0 if round_number == 0 else 1
        for stage in range(first, len(_SCALES)):
            best = self._searched(stage, points, pose, grid)
            pose, grid = best.pose, narrowed(grid, best.deviations, self._params.spread)
            if stage == 0:
                self._grid = grid
        moved = refined(self._maps.refinement, self._camera, points, pose, self._params.iterations)
        score = self._score(points, moved)
        # Where refinement went astray, by the finest map or by how far, the grid's answer stays.
        if score < self.trace[-1] or beyond_range(moved, pose, self._params.grid()):
            return pose
        self.trace.append(score)
        return moved

    def _wireframe(self, pose: Pose, round_number: int) -> Floats:
        params = self._params
        draw = self._streams("wireframe", round_number)
        points = visible_points(self._city_map, self._camera, pose, params.spacing_m, params.points, draw)
        if len(points) < _LEAST_POINTS:
            raise QueryFault(
                "the map's edges fit the photo nowhere: the best pose sees hardly any"
                if round_number
                else "the prior sees hardly an edge of the map: it may be far from the city"
            )
        return points

    def _searched(self, stage: int, points: Floats, start: Pose, grid: PoseGrid) -> Stage:
        self._city_map.usage.add("wireframes", len(grid))
        best = search_grid(self._maps.stages[stage], _SCALES[stage], self._camera, points, start, grid)
        self.trace.append(best.score)
        return best

    def _score(self, points: Floats, pose: Pose) -> float:
        self._city_map.usage.add("wireframes", 1)
        one = np.zeros((1, 3))
        scores = volume_scores(
            self._maps.stages[2], 1.0, self._camera, points - pose.center, pose.rotation[None], one
        )
        return float(scores[0, 0])
