"""The edges of a scene with what lies beside them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.rendering.topology import edge_table

Floats = NDArray[np.float64]


class EdgePairs(NamedTuple):
    """The edges of a scene by vertices, wherever these are.

    Attributes:
        corners: (E, 2) int32 vertices that they run between.
        thirds: (E, 2) int32 third vertex of either face; of a lone one twice.
        is_lone: (E,) whether there is one face only.
        is_crowded: (E,) whether there are more than two.
        starts: (B + 1,) int64 offsets by building.
    """

    corners: NDArray[np.int32]
    thirds: NDArray[np.int32]
    is_lone: NDArray[np.bool_]
    is_crowded: NDArray[np.bool_]
    starts: NDArray[np.int64]


class EdgeFaces(NamedTuple):
    """The edges of a scene with what lies beside them, for the kernel.

    Attributes:
        corners: (E, 2) int32 vertices that they run between.
        ends: (E, 2, 3) float64 end points, scene metres.
        beside: (E, 2, 3) float64 third corner of either face; of a lone one twice.
        is_lone: (E,) whether there is one face only.
        is_crowded: (E,) whether there are more than two.
        starts: (B + 1,) int64 offsets by building.
    """

    corners: NDArray[np.int32]
    ends: Floats
    beside: Floats
    is_lone: NDArray[np.bool_]
    is_crowded: NDArray[np.bool_]
    starts: NDArray[np.int64]


def edge_pairs(scene: Scene) -> EdgePairs:
    """Returns the edges of a scene; faces meet where they share both vertices, within one building."""
    table = edge_table(scene)
    # An edge of more than two faces stands in the table several times, one after the other.
    pair = np.sort(table.corners, axis=1)
    is_first = np.ones(len(pair), dtype=bool)
    is_first[1:] = (pair[1:] != pair[:-1]).any(axis=1)
    kept = np.flatnonzero(is_first)
    corners, sides = table.corners[kept], table.sides[kept]
    is_crowded = np.diff(kept, append=len(pair)) > 1
    is_lone = (sides[:, 0] == sides[:, 1]) & ~is_crowded
    thirds = np.stack([_third_corners(scene, corners, side) for side in sides.T], axis=1)
    starts = np.searchsorted(kept, table.starts).astype(np.int64)
    return EdgePairs(corners, thirds, is_lone, is_crowded, starts)


def edge_faces(scene: Scene, pairs: EdgePairs | None = None) -> EdgeFaces:
    """Returns the edges of a scene where its vertices are.

    Args:
        scene: The scene.
        pairs: Of this scene, or of one that differs in where its vertices are only; None to find them.
    """
    pairs = edge_pairs(scene) if pairs is None else pairs
    points = scene.vertices.astype(np.float64)
    ends, beside = points[pairs.corners], points[pairs.thirds]
    return EdgeFaces(pairs.corners, ends, beside, pairs.is_lone, pairs.is_crowded, pairs.starts)


def _third_corners(scene: Scene, corners: NDArray[np.int32], side: NDArray[np.int32]) -> NDArray[np.int32]:
    triangles = scene.triangles[side]
    is_end = (triangles == corners[:, :1]) | (triangles == corners[:, 1:])
    return np.asarray(triangles[np.arange(len(side)), np.argmin(is_end, axis=1)])
