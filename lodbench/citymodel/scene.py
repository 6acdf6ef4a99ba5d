"""The scene: a city at one level of detail as flat triangle arrays, ready for the renderers."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import group_cuts, starts_of
from lodbench.citymodel.raw import GrowingArray
from lodbench.errors import CityModelError

# Classes of surfaces; 0 is all else: ground, sky, what no map holds.
ROOF, WALL = 1, 2
# Surfaces whose normal is steeper than this are roofs; the renderers draw the same so.
ROOF_Z = 0.3
# Triangles merged at a time: some twenty times their size is held meanwhile.
_CHUNK_TRIANGLES = 1 << 16


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Scene:
    """Triangles of a city in its local metric frame (x east, y north, z up), grouped by building.

    Vertices and triangles of one building are contiguous, and within a building equal points are
    one vertex, so that neighbouring triangles share indices.

    Attributes:
        vertices: (V, 3) float32, metres.
        triangles: (T, 3) int32 indices into ``vertices``.
        vertex_starts: (B + 1,) int64, the vertices of building b are ``[b] .. [b + 1]``.
        triangle_starts: (B + 1,) int64, likewise for triangles.
        building_ids: B ids.
        lod: The level of detail meshed, or "" where the source has none.
        crs: CRS of ``vertices + origin``, or None for a local frame.
        origin: (3,) float64.
        pitched: (B,) which buildings have pitched roofs, as the source states, whatever shape they are drawn
            with; None where it states none.
        stored_digest: ``digest`` as the folder says from which the arrays are mapped; "" in memory.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    vertex_starts: NDArray[np.int64]
    triangle_starts: NDArray[np.int64]
    building_ids: tuple[str, ...]
    lod: str
    crs: str | None
    origin: NDArray[np.float64]
    pitched: NDArray[np.bool_] | None = None
    stored_digest: str = ""

    def __repr__(self) -> str:
        counts = f"{self.num_buildings} buildings, {len(self.triangles)} triangles"
        return f"Scene({counts}, LoD {self.lod or 'unnamed'}, {self.crs or 'local frame'})"

    @property
    def num_buildings(self) -> int:
        """Number of buildings."""
        return len(self.building_ids)

    @property
    def extent_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the lower and upper corner, (3,) each, metres in the local frame."""
        points = self.vertices.astype(np.float64)
        return points.min(axis=0), points.max(axis=0)

    def surface_classes(self) -> NDArray[np.uint8]:
        """Returns the (T,) class of each triangle by its slope: ``ROOF`` up to 72.5 deg, else ``WALL``."""
        normals = self._normals()
        is_roof = np.abs(normals[:, 2]) > ROOF_Z * np.linalg.norm(normals, axis=1)
        return np.where(is_roof, ROOF, WALL).astype(np.uint8)

    def areas_m2(self) -> NDArray[np.float64]:
        """Returns the (T,) area of each triangle."""
        return np.asarray(0.5 * np.linalg.norm(self._normals(), axis=1))

    def _normals(self) -> NDArray[np.float64]:
        """Returns (T, 3) normals as long as twice the triangle's area."""
        corners = self.vertices[self.triangles].astype(np.float64)
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    def digest(self) -> str:
        """Returns a 16-digit hexadecimal fingerprint of the geometry."""
        state = hashlib.blake2b(digest_size=8)
        for array in (self.vertices, self.triangles, self.vertex_starts, self.triangle_starts):
            state.update(np.ascontiguousarray(array).tobytes())
        return state.hexdigest()


class SceneBuilder:
    """Grows a scene building by building, so that loose triangles of a few are held at a time.

    Points are rounded to float32 first, so "equal" means equal as stored. Triangles that lose a
    corner when equal points become one vertex have no area in float32 and are left out; buildings may
    end up empty.

    Args:
        building_ids: One id per building.
    """

    def __init__(self, building_ids: tuple[str, ...]) -> None:
        self._building_ids = building_ids
        self._vertices = GrowingArray(np.float32, (3,))
        self._triangles = GrowingArray(np.int32, (3,))
        self._num_vertices = 0
        self._vertex_counts = np.zeros(len(building_ids), np.int64)
        self._triangle_counts = np.zeros(len(building_ids), np.int64)

    def add(
        self, points: NDArray[np.floating], triangles: NDArray[np.int64], building: NDArray[np.integer]
    ) -> None:
        """Adds the triangles of whole buildings, which come after all that were added before.

        Args:
            points: (P, 3) metres, local frame, finite.
            triangles: (T, 3) indices into ``points``.
            building: (T,) building of each triangle, ascending.
        """
        single = points.astype(np.float32, copy=False)
        count = len(self._building_ids)
        for first, last in pairwise(group_cuts(building, _CHUNK_TRIANGLES)):
            owner = building[first:last].astype(np.int64)
            vertices, indices, vertex_building, kept_building = _merge(single, triangles[first:last], owner)
            self._vertices.extend(vertices)
            self._triangles.extend(indices + self._num_vertices)
            self._num_vertices += len(vertices)
            self._vertex_counts += np.bincount(vertex_building, minlength=count)
            self._triangle_counts += np.bincount(kept_building, minlength=count)

    def finish(
        self,
        *,
        lod: str,
        crs: str | None,
        origin: NDArray[np.float64] | None,
        pitched: NDArray[np.bool_] | None = None,
    ) -> Scene:
        """Returns all that was added, once.

        Raises:
            CityModelError: There is no triangle.
        """
        if self._num_vertices == 0:
            raise CityModelError("The city model has no surfaces to render.", "Ask for another lod.")
        return Scene(
            vertices=self._vertices.finish(),
            triangles=self._triangles.finish(),
            vertex_starts=starts_of(self._vertex_counts),
            triangle_starts=starts_of(self._triangle_counts),
            building_ids=self._building_ids,
            lod=lod,
            crs=crs,
            origin=np.zeros(3) if origin is None else np.asarray(origin, dtype=np.float64),
            pitched=pitched,
        )


def build_scene(
    points: NDArray[np.float64],
    triangles: NDArray[np.int64],
    triangle_building: NDArray[np.int32],
    building_ids: tuple[str, ...],
    *,
    lod: str = "",
    crs: str | None = None,
    origin: NDArray[np.float64] | None = None,
    pitched: NDArray[np.bool_] | None = None,
) -> Scene:
    """Returns a scene from loose triangles: groups them by building and merges equal points.

    Args:
        points: (P, 3) float64, metres, local frame.
        triangles: (T, 3) indices into ``points``.
        triangle_building: (T,) building index of each triangle, in any order.
        building_ids: One id per building.
        lod: Level of detail to record.
        crs: CRS to record.
        origin: (3,) float64 to record, zero by default.
        pitched: As of ``Scene``.

    Raises:
        CityModelError: A coordinate is not finite, or there is no triangle at all.
    """
    if not np.isfinite(points).all():
        raise CityModelError("The city model has coordinates that are not finite.")
    order = np.argsort(triangle_building, kind="stable")
    builder = SceneBuilder(building_ids)
    builder.add(points, triangles[order], triangle_building[order])
    return builder.finish(lod=lod, crs=crs, origin=origin, pitched=pitched)


def _merge(
    points: NDArray[np.float32], triangles: NDArray[np.int64], building: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Returns the vertices and triangles of whole buildings, and the building of each of both."""
    corners = points[triangles].reshape(-1, 3) + np.float32(0)  # no -0.0
    corner_building = np.repeat(building, 3)
    numbers, first = number_rows([corner_building.astype(np.uint64), *point_bits(corners)])
    indices = numbers.reshape(-1, 3)
    kept = (
        (indices[:, 0] != indices[:, 1]) & (indices[:, 1] != indices[:, 2]) & (indices[:, 2] != indices[:, 0])
    )
    return corners[first], indices[kept], corner_building[first], building[kept]


Floats = NDArray[np.float64]


class BuildingBoxes(NamedTuple):
    """Boxes along the axes around buildings; those without triangles are left out."""

    low: Floats  # (B, 3) least coordinates, local metres
    high: Floats  # (B, 3) greatest coordinates
    building: NDArray[np.int64]  # (B,) number of each in the scene

    @property
    def bases(self) -> Floats:
        """Returns the middle of each building's base, (B, 3) local metres."""
        return np.column_stack([0.5 * (self.low[:, :2] + self.high[:, :2]), self.low[:, 2]])

    def are_clear_of(self, center: Floats, clearance_m: float) -> bool:
        """Returns whether a camera centre, (3,), keeps a distance from every box, sideways and above."""
        below = center[2] < self.high[:, 2] + clearance_m
        off = np.maximum(self.low[:, :2] - center[:2], center[:2] - self.high[:, :2])
        return not bool((below & (off < clearance_m).all(axis=1)).any())


def building_boxes(scene: Scene) -> BuildingBoxes:
    """Returns the boxes around a scene's buildings."""
    filled = np.flatnonzero(np.diff(scene.vertex_starts) > 0)
    # Empty buildings own no vertices, so the starts of the others still bound them.
    starts, points = scene.vertex_starts[filled], scene.vertices.astype(np.float64)
    return BuildingBoxes(np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts), filled)


def floors_and_rises(scene: Scene) -> tuple[Floats, Floats]:
    """Returns (B,) the lowest height of each building, and (B,) its height from there, metres; else 0."""
    low, high, building = building_boxes(scene)
    floors, rises = np.zeros((2, scene.num_buildings))
    floors[building], rises[building] = low[:, 2], high[:, 2] - low[:, 2]
    return floors, rises


# An odd number (2**64 over the golden ratio) and one of splitmix64, which spread bits.
HASH_ODD, HASH_MIXER, HASH_SHIFT = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(31)


def number_rows(columns: list[NDArray[np.uint64]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns a number for every row, equal for equal rows, and the first row of each number.

    Numbers count up in the order of first occurrence.

    Args:
        columns: Arrays (N,) of bits; a row is one entry of each.

    Returns:
        numbers: (N,) int64.
        first: (U,) int64 ascending.

    Example:
        >>> number_rows([np.array([7, 5, 7], np.uint64)])[0]
        array([0, 1, 0])
    """
    key = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        key = (key ^ column) * HASH_ODD
        key = (key ^ (key >> HASH_SHIFT)) * HASH_MIXER
    order = np.argsort(key, kind="stable")
    is_new = _changes([key], order)
    if not np.array_equal(is_new, _changes(columns, order)):
        # Two rows share a hash: sort by the rows themselves.
        order = np.lexsort(columns)
        is_new = _changes(columns, order)
    group = np.cumsum(is_new) - 1
    first = order[is_new]  # a stable sort keeps the earliest row of a group in front
    by_occurrence = np.argsort(first)
    rank = np.empty_like(by_occurrence)
    rank[by_occurrence] = np.arange(len(first))
    numbers = np.empty(len(order), np.int64)
    numbers[order] = rank[group]
    return numbers, first[by_occurrence]


def connected_components(
    num_nodes: int, first: NDArray[np.int64], second: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Returns the smallest node of each node's component.

    Args:
        num_nodes: Nodes are 0 .. num_nodes - 1.
        first: (E,) one end of every edge.
        second: (E,) the other end.
    """
    from scipy.sparse import coo_array, csgraph

    edges = coo_array((np.ones(len(first), np.bool_), (first, second)), shape=(num_nodes, num_nodes))
    count, labels = csgraph.connected_components(edges, directed=False)
    smallest: NDArray[np.int64] = np.full(count, num_nodes, np.int64)
    np.minimum.at(smallest, labels, np.arange(num_nodes))
    return np.asarray(smallest[labels])


def _changes(columns: list[NDArray[np.uint64]], order: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Returns where a row differs from the one before it in the given order."""
    is_new = np.zeros(len(order), np.bool_)
    is_new[:1] = True
    for column in columns:
        ordered = column[order]
        is_new[1:] |= ordered[1:] != ordered[:-1]
    return is_new


def point_bits(points: NDArray[np.floating]) -> list[NDArray[np.uint64]]:
    """Returns the bits of points, (N, 3) of any float type, as three columns; -0.0 counts as 0.0."""
    word = np.uint32 if points.dtype == np.float32 else np.uint64
    bits = np.ascontiguousarray((points + points.dtype.type(0)).T).view(word)
    return [column.astype(np.uint64) for column in bits]
