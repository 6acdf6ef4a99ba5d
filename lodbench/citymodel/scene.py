"""The scene: a city at one level of detail as flat triangle arrays, ready for the renderers."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.identity import number_rows, point_bits
from lodbench.errors import CityModelError

# Triangles merged at a time: some twenty times their size is held meanwhile.
_CHUNK_TRIANGLES = 1 << 16


@dataclass(frozen=True, slots=True, eq=False)
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
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    vertex_starts: NDArray[np.int64]
    triangle_starts: NDArray[np.int64]
    building_ids: tuple[str, ...]
    lod: str
    crs: str | None
    origin: NDArray[np.float64]

    @property
    def num_buildings(self) -> int:
        """Number of buildings."""
        return len(self.building_ids)

    @property
    def extent_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the lower and upper corner, (3,) each, metres in the local frame."""
        points = self.vertices.astype(np.float64)
        return points.min(axis=0), points.max(axis=0)

    def digest(self) -> str:
        """Returns a 16-digit hexadecimal fingerprint of the geometry."""
        state = hashlib.blake2b(digest_size=8)
        for array in (self.vertices, self.triangles, self.vertex_starts, self.triangle_starts):
            state.update(np.ascontiguousarray(array).tobytes())
        return state.hexdigest()


def build_scene(
    points: NDArray[np.float64],
    triangles: NDArray[np.int64],
    triangle_building: NDArray[np.int32],
    building_ids: tuple[str, ...],
    *,
    lod: str = "",
    crs: str | None = None,
    origin: NDArray[np.float64] | None = None,
) -> Scene:
    """Returns a scene from loose triangles: groups them by building and merges equal points.

    Points are rounded to float32 first, so "equal" means equal as stored. Triangles that lose a
    corner by the merge have no area in float32 and are left out; buildings may end up empty.

    Args:
        points: (P, 3) float64, metres, local frame.
        triangles: (T, 3) indices into ``points``.
        triangle_building: (T,) building index of each triangle, in any order.
        building_ids: One id per building.
        lod: Level of detail to record.
        crs: CRS to record.
        origin: (3,) float64 to record, zero by default.

    Raises:
        CityModelError: A coordinate is not finite, or there is no triangle at all.
    """
    if len(triangles) == 0:
        raise CityModelError("The city model has no surfaces to render.", "Ask for another lod.")
    if not np.isfinite(points).all():
        raise CityModelError("The city model has coordinates that are not finite.")
    order = np.argsort(triangle_building, kind="stable")
    building = triangle_building[order].astype(np.int64)
    single = points.astype(np.float32)
    parts, num_vertices = [], 0
    for first, last in pairwise(_cuts(building, len(building_ids))):
        part = _merge(single, triangles[order[first:last]], building[first:last], num_vertices)
        num_vertices += len(part[0])
        parts.append(part)
    vertices, indices, vertex_building, kept_building = (
        np.concatenate(arrays) for arrays in zip(*parts, strict=True)
    )
    bounds = np.arange(len(building_ids) + 1)
    return Scene(
        vertices=vertices,
        triangles=indices,
        vertex_starts=np.searchsorted(vertex_building, bounds).astype(np.int64),
        triangle_starts=np.searchsorted(kept_building, bounds).astype(np.int64),
        building_ids=building_ids,
        lod=lod,
        crs=crs,
        origin=np.zeros(3) if origin is None else np.asarray(origin, dtype=np.float64),
    )


def _cuts(building: NDArray[np.int64], count: int) -> list[int]:
    """Returns where to cut a sorted list of triangles: between buildings, into chunks of a few."""
    bounds = np.searchsorted(building, np.arange(count + 1))
    wanted = np.arange(0, len(building), _CHUNK_TRIANGLES)
    cuts = np.unique(bounds[np.searchsorted(bounds, wanted)])
    return [*cuts[cuts < len(building)].tolist(), len(building)]


def _merge(
    points: NDArray[np.float32], triangles: NDArray[np.int64], building: NDArray[np.int64], offset: int
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int64], NDArray[np.int64]]:
    """Returns the vertices and triangles of whole buildings, and the building of each of both.

    Args:
        points: (P, 3).
        triangles: (T, 3) indices into ``points``.
        building: (T,) ascending.
        offset: Vertices of the buildings before.
    """
    corners = points[triangles].reshape(-1, 3) + np.float32(0)  # no -0.0
    corner_building = np.repeat(building, 3)
    numbers, first = number_rows([corner_building.astype(np.uint64), *point_bits(corners)])
    indices = numbers.reshape(-1, 3)
    kept = (
        (indices[:, 0] != indices[:, 1]) & (indices[:, 1] != indices[:, 2]) & (indices[:, 2] != indices[:, 0])
    )
    indices = (indices[kept] + offset).astype(np.int32)
    return corners[first], indices, corner_building[first], building[kept]
