"""A map whose roofs, bases and overhangs differ from the original's by offsets: three of all, one per roof.

Blocks end somewhere between eaves and ridge, and are as wide as walls or as roofs, by the decision of the
map's maker: errors of its roofs are common to all. Estimated poses that lack this offset are too high or too
low (docs/adr/0012, points 1 and 3). The same holds for bases that a slope, a hedge or cars hide (point 4).
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

# Faces whose unit normal has a smaller vertical part than this are walls.
_WALL_RISE = 0.3
# Keeps the equations of corners between two walls in one line solvable.
_REGULARIZATION = 1e-4
# The farthest that a corner moves when its walls move outward by 1.
_LONGEST_CORNER_MOVE = 2.0
# Edges that are shorter horizontally have no direction, metres.
_SHORTEST_M = 1e-3


def outward_moves(edges: EdgeFaces, num_vertices: int) -> Floats:
    """Returns (V, 2) the move of each vertex, east and north, if all walls of its building move out by 1 m.

    Outward is the direction away from the roof, or floor, that meets a wall at an edge: faces of published
    models are oriented at random. Vertices at which no wall meets a roof or floor do not move.

    Args:
        edges: the edges of a scene.
        num_vertices: number of vertices of that scene, V.
    """
    along = edges.ends[:, 1] - edges.ends[:, 0]
    opposite = edges.opposite - edges.ends[:, :1]
    normals = np.cross(along[:, None, :], opposite)
    is_wall = np.abs(normals[..., 2]) < _WALL_RISE * np.linalg.norm(normals, axis=2)
    length = np.hypot(along[:, 0], along[:, 1])
    meets = (is_wall[:, 0] != is_wall[:, 1]) & (length > _SHORTEST_M)
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)[meets] / length[meets, None]
    of_roof = np.where(is_wall[meets, :1], opposite[meets, 1, :2], opposite[meets, 0, :2])
    across *= np.where((across * of_roof).sum(axis=1) > 0, -1.0, 1.0)[:, None]
    return _moves_of_corners(edges.corners[meets], across, num_vertices)


def _moves_of_corners(corners: NDArray[np.int32], outward: Floats, count: int) -> Floats:
    """Returns (V, 2) the moves of vertices that move their edges, (E, 2), by 1 m along (E, 2) normals."""
    squares, sums = np.zeros((count, 2, 2)), np.zeros((count, 2))
    for end in (0, 1):
        np.add.at(squares, corners[:, end], outward[:, :, None] * outward[:, None, :])
        np.add.at(sums, corners[:, end], outward)
    moves = np.linalg.solve(squares + _REGULARIZATION * np.eye(2), sums[..., None])[..., 0]
    far = np.linalg.norm(moves, axis=1, keepdims=True)
    return np.asarray(moves * np.minimum(1.0, _LONGEST_CORNER_MOVE / np.maximum(far, _LONGEST_CORNER_MOVE)))


Item = TypeVar("Item")
Result = TypeVar("Result")

# Silhouettes are drawn at discrete roof levels, this far apart, metres.
ROOF_LEVEL_STEP_M = 0.5
# The largest offset of the roof levels from the map, metres.
_FARTHEST_M = 3.0
# The least height of a lowered roof above its base, metres.
_LOWEST_M = 2.0
# Buildings of less height are flat outlines: neither roof nor base moves, metres.
_FLAT_M = 0.1


class RaisedRoofs:
    """Some buildings of a map, with offsets of roofs, bases and overhangs; drawn at discrete roof levels.

    A roof level is an index: all roofs are ``ROOF_LEVEL_STEP_M`` times it higher than at level 0.
    Silhouettes count as drawn from the map.

    Args:
        city_map: the map.
        part: the scene of those of its buildings that are drawn.
        pitched_lower_m: how much lower than in the map blocks are whose source states a pitched roof, metres.

    Attributes:
        building_roof_offsets_m: (B,) how much higher each roof is than all roofs, metres.
        base_offset_m: how much higher than in the map all bases are, metres.
        overhang_m: how much farther than in the map all eaves project horizontally, metres.
        threads: number of threads of the map.
        is_tall: (B,) whether a building is more than a flat outline.
    """

    def __init__(self, city_map: CityMap, part: Scene, pitched_lower_m: float = 0.0) -> None:
        self._part, self.threads = part, city_map.threads
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self._map = cache(lambda: _map_of(part, city_map))
        self.building_roof_offsets_m = np.zeros(part.num_buildings)
        self.base_offset_m, self.overhang_m = 0.0, 0.0
        self._drawn: dict[int, CityMap] = {}
        self._floors, self._rises = floors_and_rises(part)
        self.is_tall = self._rises > _FLAT_M
        self._declared_m = -pitched_lower_m * pitched_blocks(part)

    def with_offsets(
        self, building_roof_offsets_m: Floats, base_offset_m: float, overhang_m: float
    ) -> RaisedRoofs:
        """Returns the same buildings with other offsets; see the attributes of the same names."""
        other = copy(self)
        other.building_roof_offsets_m, other._drawn = building_roof_offsets_m, {}
        other.base_offset_m, other.overhang_m = base_offset_m, overhang_m
        return other

    def parallel_map(self, work: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
        """Starts a function on all items, on the map's threads, and returns the results in order.

        With one thread, each result is computed when it is requested. No call may wait for another.
        """
        return map(work, items) if self._pool is None else self._pool.map(work, items)

    @cached_property
    def _outward(self) -> Floats:
        return outward_moves(self._map().edge_faces, len(self._part.vertices))

    def at(self, roof_level: int) -> CityMap:
        """Returns the map of the buildings at a roof level."""
        if roof_level not in self._drawn:
            part = self._part
            owner = np.repeat(np.arange(part.num_buildings), np.diff(part.vertex_starts))
            heights = part.vertices[:, 2].astype(np.float64)
            vertices = part.vertices.copy()
            relative = self._relative_heights(heights, owner, self._floors, self._rises)
            by_base = self.is_tall[owner] * (1.0 - relative)
            roof_offsets, base_offsets = self._roof_offsets(roof_level), self._base_offsets(roof_level)
            vertices[:, 2] = heights + relative * roof_offsets[owner] + by_base * base_offsets[owner]
            if self.overhang_m != 0.0:
                vertices[:, :2] += (self.overhang_m * relative)[:, None] * self._outward
            # A dozen of these live and die with each query.
            self._drawn[roof_level] = self._map().with_vertices(vertices)
        return self._drawn[roof_level]

    def relative_heights(self, heights: Floats, buildings: NDArray[np.int64], roof_level: int) -> Floats:
        """Returns (N,) the heights of points as fractions of their buildings' heights: 0 base, 1 ridge.

        This is also how much a point moves up, in metres, if roofs are 1 m higher.

        Args:
            heights: (N,) heights of points of the map at the roof level, metres.
            buildings: (N,) their buildings.
            roof_level: the roof level.
        """
        base_offsets = self._base_offsets(roof_level)
        rises = self._rises + self._roof_offsets(roof_level) - base_offsets
        return self._relative_heights(heights, buildings, self._floors + base_offsets, rises)

    def lifts(self, heights: Floats, buildings: NDArray[np.int64], roof_level: int) -> Floats:
        """Returns (N,) how much points move up, in metres, if bases are 1 m higher; 0 for flat outlines.

        The arguments are those of ``relative_heights``.
        """
        relative = self.relative_heights(heights, buildings, roof_level)
        return np.asarray(self.is_tall[buildings] * (1.0 - relative))

    def outward(self, corners: NDArray[np.int32], edge_fractions: Floats) -> Floats:
        """Returns (N, 2) the moves of points of edges, east and north, if all walls move out by 1 m.

        Args:
            corners: (N, 2) the vertices of the part between which the edges run.
            edge_fractions: (N,) positions of the points along their edges, 0 to 1.
        """
        first, last = (self._outward[end] for end in corners.T)
        return np.asarray(first + edge_fractions[:, None] * (last - first))

    def _relative_heights(
        self, heights: Floats, buildings: NDArray[np.int64], floors: Floats, rises: Floats
    ) -> Floats:
        relative = (heights - floors[buildings]) / np.maximum(rises[buildings], _FLAT_M)
        return np.asarray(np.where(self.is_tall[buildings], np.clip(relative, 0.0, 1.0), 0.0))

    def _roof_offsets(self, roof_level: int) -> Floats:
        """Returns (B,) how much higher than in the map each roof is at a roof level, metres."""
        lowest = np.minimum(_LOWEST_M - self._rises, 0.0)
        wanted = roof_level * ROOF_LEVEL_STEP_M + self._declared_m + self.building_roof_offsets_m
        return np.where(self.is_tall, np.maximum(wanted, lowest), 0.0)

    def _base_offsets(self, roof_level: int) -> Floats:
        """Returns (B,) how much higher than in the map each base is at a roof level, metres."""
        most = np.maximum(self._rises + self._roof_offsets(roof_level) - _LOWEST_M, 0.0)
        return np.where(self.is_tall, np.minimum(self.base_offset_m, most), 0.0)


def _map_of(part: Scene, city_map: CityMap) -> CityMap:
    drawn = CityMap(part, threads=city_map.threads)
    drawn.usage = city_map.usage
    return drawn


def roof_level_of(roof_offset_m: Floats) -> NDArray[np.int64]:
    """Returns the roof levels nearest to offsets of all roofs, metres."""
    nearest = np.rint(np.clip(roof_offset_m, -_FARTHEST_M, _FARTHEST_M) / ROOF_LEVEL_STEP_M)
    return np.asarray(nearest, dtype=np.int64)
