"""How much higher and wider than in the map all roofs are, and where walls end: three numbers, metres.

Blocks end somewhere between eaves and ridge, and are as wide as walls or as roofs, as whoever made the map
decided: its roofs err alike. The photo shows by how much, and a camera that has to make up for it ends too
high or too low (docs/adr/0012, points 1 and 3). So do walls that end higher than in the map, at a slope, a
hedge or cars (docs/adr/0012, point 4).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import cache, cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.extrude import pitched_blocks
from lodbench.citymodel.scene import Scene, floors_and_rises
from lodbench.kernels.arguments import EdgeFaces

Floats = NDArray[np.float64]

# What counts as a wall: the most that its normal rises or falls, as a share of its length.
_WALL_RISE = 0.3
# Walls in one line count as one; corners move out by twice the distance of their walls at most.
_IN_LINE, _SHARPEST = 1e-4, 2.0
# Shorter edges have no direction, metres.
_SHORTEST_M = 1e-3


def outward_moves(edges: EdgeFaces, num_vertices: int) -> Floats:
    """Returns (V, 2) how far each vertex moves east and north where its building is a metre wider all around.

    Out is away from the roof, or floor, that meets a wall at an edge: faces of published models are oriented
    at random. What no wall meets does not move.

    Args:
        edges: Of a scene.
        num_vertices: Of the scene, V.
    """
    along = edges.ends[:, 1] - edges.ends[:, 0]
    third = edges.beside - edges.ends[:, :1]
    normals = np.cross(along[:, None, :], third)
    is_wall = np.abs(normals[..., 2]) < _WALL_RISE * np.linalg.norm(normals, axis=2)
    length = np.hypot(along[:, 0], along[:, 1])
    meets = (is_wall[:, 0] != is_wall[:, 1]) & (length > _SHORTEST_M)
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)[meets] / length[meets, None]
    of_roof = np.where(is_wall[meets, :1], third[meets, 1, :2], third[meets, 0, :2])
    across *= np.where((across * of_roof).sum(axis=1) > 0, -1.0, 1.0)[:, None]
    return _moves_of_corners(edges.corners[meets], across, num_vertices)


def _moves_of_corners(corners: NDArray[np.int32], outward: Floats, count: int) -> Floats:
    """Returns (V, 2) moves of vertices that move all edges (E, 2) at them outward, (E, 2), by a metre."""
    squares, sums = np.zeros((count, 2, 2)), np.zeros((count, 2))
    for end in (0, 1):
        np.add.at(squares, corners[:, end], outward[:, :, None] * outward[:, None, :])
        np.add.at(sums, corners[:, end], outward)
    moves = np.linalg.solve(squares + _IN_LINE * np.eye(2), sums[..., None])[..., 0]
    far = np.linalg.norm(moves, axis=1, keepdims=True)
    return np.asarray(moves * np.minimum(1.0, _SHARPEST / np.maximum(far, _SHARPEST)))


Item = TypeVar("Item")
Result = TypeVar("Result")

# Silhouettes are drawn of roofs at every so many metres, up to so far from the map.
STEP_M, _FARTHEST_M = 0.5, 3.0
# How far roofs stay above where walls end at least, and what has no height that could err.
_LOWEST_M, _FLAT_M = 2.0, 0.1


class RaisedRoofs:
    """Some buildings of a map with all roofs higher or lower, wider or narrower, and walls ending elsewhere.

    What is drawn of them counts as drawn of the map.

    Args:
        city_map: The map.
        part: The scene of those of its buildings that are to be drawn.
        pitched_lower_m: How much lower than in the map blocks of pitched roofs are, metres.

    Attributes:
        own_m: (B,) how much higher than all the others each roof is, metres.
        bases_m: How much higher than in the map all walls end, metres.
        eaves_m: How much farther than in the map all eaves stand out, metres.
        threads: Of the map.
        is_tall: (B,) whether a building has a height that could err.
    """

    def __init__(self, city_map: CityMap, part: Scene, pitched_lower_m: float = 0.0) -> None:
        self._part, self.threads = part, city_map.threads
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self._map = cache(lambda: _map_of(part, city_map))
        self.own_m, self.bases_m, self.eaves_m = np.zeros(part.num_buildings), 0.0, 0.0
        self._drawn: dict[int, CityMap] = {}
        self._floors, self._rises = floors_and_rises(part)
        self.is_tall = self._rises > _FLAT_M
        self._declared_m = -pitched_lower_m * pitched_blocks(part)

    def with_offsets(self, own_m: Floats, bases_m: float, eaves_m: float) -> RaisedRoofs:
        """Returns the same buildings with each roof so much higher than all the others, (B,) metres.

        Args:
            own_m: Of each building.
            bases_m: How much higher than in the map all walls end, metres.
            eaves_m: How much farther than in the map all eaves stand out, metres.
        """
        other = copy(self)
        other.own_m, other.bases_m, other.eaves_m, other._drawn = own_m, bases_m, eaves_m, {}
        return other

    def parallel_map(self, work: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
        """Begins a work on each item, on as many threads as the map has, and returns the results in order.

        With one thread each is worked on when its result is asked for. No work may wait for another.
        """
        return map(work, items) if self._pool is None else self._pool.map(work, items)

    @cached_property
    def _outward(self) -> Floats:
        return outward_moves(self._map().edge_faces, len(self._part.vertices))

    def at(self, step: int) -> CityMap:
        """Returns the map of the buildings with roofs so many steps higher."""
        if step not in self._drawn:
            part = self._part
            owner = np.repeat(np.arange(part.num_buildings), np.diff(part.vertex_starts))
            heights = part.vertices[:, 2].astype(np.float64)
            vertices = part.vertices.copy()
            shares = self._shares(heights, owner, self._floors, self._rises)
            lifts = self.is_tall[owner] * (1.0 - shares)
            vertices[:, 2] = heights + shares * self._raised(step)[owner] + lifts * self._lifted(step)[owner]
            if self.eaves_m != 0.0:
                vertices[:, :2] += (self.eaves_m * shares)[:, None] * self._outward
            # A dozen of these live and die with each query.
            self._drawn[step] = self._map().with_vertices(vertices)
        return self._drawn[step]

    def shares(self, heights: Floats, buildings: NDArray[np.int64], step: int) -> Floats:
        """Returns at which share of its building's height points of the map at a step are, (N,).

        By that much of a metre they move up where roofs are a metre higher.

        Args:
            heights: (N,) metres.
            buildings: (N,) of the part.
            step: Of the map that the points are of.
        """
        lifted = self._lifted(step)
        rises = self._rises + self._raised(step) - lifted
        return self._shares(heights, buildings, self._floors + lifted, rises)

    def lifts(self, heights: Floats, buildings: NDArray[np.int64], step: int) -> Floats:
        """Returns by how much of a metre points move up where walls end a metre higher, (N,).

        What has no height has no walls: flat outlines stay.

        Args:
            heights: As of ``shares``.
            buildings: As of ``shares``.
            step: As of ``shares``.
        """
        return np.asarray(self.is_tall[buildings] * (1.0 - self.shares(heights, buildings, step)))

    def outward(self, corners: NDArray[np.int32], places: Floats) -> Floats:
        """Returns (N, 2) how far points of edges move east and north where walls stand out a metre farther.

        Args:
            corners: (N, 2) vertices of the part, between which the edges run.
            places: (N,) where the points are on them, 0 to 1.
        """
        first, last = (self._outward[end] for end in corners.T)
        return np.asarray(first + places[:, None] * (last - first))

    def _shares(self, heights: Floats, buildings: NDArray[np.int64], floors: Floats, rises: Floats) -> Floats:
        shares = (heights - floors[buildings]) / np.maximum(rises[buildings], _FLAT_M)
        return np.asarray(np.where(self.is_tall[buildings], np.clip(shares, 0.0, 1.0), 0.0))

    def _raised(self, step: int) -> Floats:
        """Returns (B,) by how much each roof is higher at a step, metres; what is flat has none."""
        lowest = np.minimum(_LOWEST_M - self._rises, 0.0)
        return np.where(self.is_tall, np.maximum(step * STEP_M + self._declared_m + self.own_m, lowest), 0.0)

    def _lifted(self, step: int) -> Floats:
        """Returns (B,) by how much each building's walls end higher at a step, metres."""
        most = np.maximum(self._rises + self._raised(step) - _LOWEST_M, 0.0)
        return np.where(self.is_tall, np.minimum(self.bases_m, most), 0.0)


def _map_of(part: Scene, city_map: CityMap) -> CityMap:
    drawn = CityMap(part, threads=city_map.threads)
    drawn.usage = city_map.usage
    return drawn


def step_of(roofs_m: Floats) -> NDArray[np.int64]:
    """Returns the step nearest to roofs so much higher, metres."""
    nearest = np.rint(np.clip(roofs_m, -_FARTHEST_M, _FARTHEST_M) / STEP_M)
    return np.asarray(nearest, dtype=np.int64)
