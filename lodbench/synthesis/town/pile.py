"""Triangles of props while they are collected, and the plane meshes that lie on the ground."""

from __future__ import annotations

from collections.abc import Callable

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.props import SceneProps, SurfaceClass

Points = NDArray[np.float64]
Triangles = NDArray[np.int64]
Tint = NDArray[np.float64] | tuple[int, int, int]


class PropPile:
    """Collects triangles, and numbers the objects they belong to.

    Args:
        num_buildings: Numbers that are taken already.
    """

    def __init__(self, num_buildings: int) -> None:
        self._num_buildings = num_buildings
        self._num_objects = num_buildings
        self._parts: list[tuple[Points, Triangles, NDArray[np.uint8], NDArray[np.int64], Points]] = []
        self._num_points = 0

    def new_objects(self, count: int) -> NDArray[np.int64]:
        """Returns so many fresh numbers, (count,)."""
        first, self._num_objects = self._num_objects, self._num_objects + count
        return np.arange(first, self._num_objects)

    def add(
        self,
        surface: SurfaceClass | NDArray[np.uint8],
        points: Points,
        triangles: Triangles,
        tint: Tint,
        objects: NDArray[np.int64] | int | None = None,
    ) -> None:
        """Adds triangles.

        Args:
            surface: Class of all, or (T,) of each.
            points: (P, 3) local metres.
            triangles: (T, 3) indices into ``points``.
            tint: RGB of all, or (T, 3) of each.
            objects: Object of all, or (T,) of each; None for a new one.
        """
        count = len(triangles)
        if objects is None:
            objects = self.new_objects(1)[0]
        self._parts.append(
            (
                points,
                triangles + self._num_points,
                np.broadcast_to(np.asarray(surface, np.uint8), count),
                np.broadcast_to(np.asarray(objects, np.int64), count),
                np.broadcast_to(np.asarray(tint, np.float64), (count, 3)),
            )
        )
        self._num_points += len(points)

    def build(self, origin: Points) -> SceneProps:
        """Returns everything added, in the frame of an origin, (3,)."""
        points, triangles, surface, objects, tint = (
            np.concatenate(arrays) for arrays in zip(*self._parts, strict=True)
        )
        return SceneProps(
            vertices=points.astype(np.float32),
            triangles=triangles.astype(np.int32),
            surface=surface,
            objects=objects.astype(np.int32),
            tint=np.clip(np.round(tint), 0, 255).astype(np.uint8),
            num_buildings=self._num_buildings,
            origin=np.asarray(origin, dtype=np.float64),
        )


def filled(ring: Points) -> tuple[Points, Triangles]:
    """Returns a ring's corners, (N, 2), and the triangles that fill it, counter-clockwise."""
    corners = np.ascontiguousarray(ring, dtype=np.float64)
    indices = mapbox_earcut.triangulate_float64(corners, np.array([len(corners)], np.uint32))
    triangles = np.asarray(indices, dtype=np.int64).reshape(-1, 3)
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    return corners, np.where((turn < 0)[:, None], triangles[:, ::-1], triangles)


def refined(
    points: Points, triangles: Triangles, longest: Callable[[Points], Points]
) -> tuple[Points, Triangles]:
    """Returns a plane mesh whose edges are nowhere longer than wanted, without cracks.

    Edges are halved, both triangles beside them alike, until all are short enough.

    Args:
        points: (P, 2) metres.
        triangles: (T, 3).
        longest: Returns the wanted length, (N,), of edges with middles (N, 2).
    """
    while True:
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        keys, inverse = np.unique(edges[:, 0] * len(points) + edges[:, 1], return_inverse=True)
        first, second = np.divmod(keys, len(points))
        middles = 0.5 * (points[first] + points[second])
        is_long = np.linalg.norm(points[second] - points[first], axis=1) > longest(middles)
        if not is_long.any():
            return points, triangles
        numbers = np.where(is_long, len(points) + np.cumsum(is_long) - 1, -1)
        triangles = _split(triangles, numbers[inverse].reshape(-1, 3))
        points = np.concatenate([points, middles[is_long]])


def _split(triangles: Triangles, middles: Triangles) -> Triangles:
    """Returns triangles split at the middles of their edges 01, 12 and 20, (T, 3), -1 for whole edges."""
    parts = [triangles[(middles < 0).all(axis=1)]]
    for k in range(3):
        # Turned so that the pattern of split edges is one of three.
        corner, middle = np.roll(triangles, -k, axis=1), np.roll(middles, -k, axis=1)
        a, b, c = corner.T
        ab, bc, ca = middle.T
        one = (ab >= 0) & (bc < 0) & (ca < 0)
        two = (ab >= 0) & (bc >= 0) & (ca < 0)
        for chosen, fans in (
            (one, [(a, ab, c), (ab, b, c)]),
            (two, [(ab, b, bc), (a, ab, bc), (a, bc, c)]),
        ):
            parts += [np.stack(fan, axis=1)[chosen] for fan in fans]
    a, b, c = triangles.T
    ab, bc, ca = middles.T
    all_three = (middles >= 0).all(axis=1)
    for fan in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)):
        parts.append(np.stack(fan, axis=1)[all_three])
    return np.concatenate(parts)


def offset_line(line: Points, distance: float) -> Points:
    """Returns a polyline, (K, 2), moved to its left."""
    way = np.gradient(line, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return np.asarray(line + distance * np.stack([-way[:, 1], way[:, 0]], axis=1))


def along_line(line: Points, at: Points) -> tuple[Points, Points]:
    """Returns positions, (N, 2), and unit directions, (N, 2), at distances along a polyline."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    starts = np.concatenate([[0.0], np.cumsum(steps)])
    k = np.clip(np.searchsorted(starts, at, side="right") - 1, 0, len(steps) - 1)
    direction = np.diff(line, axis=0)[k] / steps[k, None]
    return line[k] + (at - starts[k])[:, None] * direction, direction


def length_of(line: Points) -> float:
    """Returns the length of a polyline, metres."""
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
