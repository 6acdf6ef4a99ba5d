"""How the outlines of roofs move where eaves stand out farther than in the map.

Blocks are as wide as walls in one city and as roofs in the next, as whoever made the map decided: their roofs
err alike (docs/adr/0054).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.rendering.edge_faces import EdgeFaces

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
