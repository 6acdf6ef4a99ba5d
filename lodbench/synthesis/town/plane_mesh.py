"""Meshes of plane figures, refined so that they can be draped over the ground."""

from __future__ import annotations

from collections.abc import Callable

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Triangles = NDArray[np.int64]


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
