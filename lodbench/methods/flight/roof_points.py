"""Points of a building's upper side, where photos are compared: on a grid over it, and along its edges."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Faces steeper than this are walls: the upward part of their unit normal.
_FLAT = 0.3
# A roof has so many points at most, no closer than this, metres; so many triangles are looked at at once.
_MOST_POINTS, _SPACING_M, _TRIANGLES = 144, 0.4, 2048
# The same along its edges; shorter ones are left out.
_MOST_OF_EDGES, _APART_M, _SHORTEST_M = 160, 0.5, 0.3
# Corners are the same within this, metres. Two faces are one whose normals' mean is longer than that.
_CORNER_M, _ONE_FACE = 0.01, 0.992
# What lies lower than this share of a building's height is its floor.
_FLOOR = 0.1


def roof_points(triangles: Floats) -> Floats:
    """Returns points of the upper side of a building on a grid, and their share of its height, (N, 4).

    A building that is higher is so as a whole: its eaves rise less than its ridge. Triangles are (T, 3, 3).
    """
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    flat = triangles[np.abs(normals[:, 2]) > _FLAT * np.linalg.norm(normals, axis=1)]
    if len(flat) == 0:
        return np.zeros((0, 4))
    low, high = flat[..., :2].min(axis=(0, 1)), flat[..., :2].max(axis=(0, 1))
    step = max(_SPACING_M, math.sqrt(float(np.prod(high - low)) / _MOST_POINTS))
    sides = [np.arange(a + 0.5 * step, b, step) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 1, 2)
    tops = np.full(len(places), -np.inf)
    for first in range(0, len(flat), _TRIANGLES):
        tops = np.maximum(tops, _heights_over(flat[first : first + _TRIANGLES], places))
    floor, top = triangles[..., 2].min(), triangles[..., 2].max()
    points = np.column_stack([places[:, 0], tops, (tops - floor) / max(top - floor, 1e-6)])
    return np.asarray(points[np.isfinite(tops)])


def _heights_over(triangles: Floats, places: Floats) -> Floats:
    """Returns (N,) the greatest height of (T, 3, 3) triangles over (N, 1, 2) places, -inf over none."""
    a, b, c = (triangles[:, k] for k in range(3))
    ab, ac, ap = (b - a)[:, :2], (c - a)[:, :2], places - a[:, :2]
    whole = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    along_b = (ap[..., 0] * ac[:, 1] - ap[..., 1] * ac[:, 0]) / whole
    along_c = (ab[:, 0] * ap[..., 1] - ab[:, 1] * ap[..., 0]) / whole
    inside = (along_b >= 0) & (along_c >= 0) & (along_b + along_c <= 1)
    heights = a[:, 2] + along_b * (b - a)[:, 2] + along_c * (c - a)[:, 2]
    return np.asarray(np.where(inside, heights, -np.inf).max(axis=1))


def edge_points(triangles: Floats) -> Floats:
    """Returns points of the edges of a building's upper side, their share of its height, and directions.

    Args:
        triangles: (T, 3, 3) metres.

    Returns:
        (N, 7): places, shares, unit vectors along the edge.
    """
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    is_flat = np.abs(normals[:, 2]) > _FLAT * lengths
    flat, upward = triangles[is_flat], normals[is_flat] / np.maximum(lengths[is_flat], 1e-12)[:, None]
    if len(flat) == 0:
        return np.zeros((0, 7))
    upward *= np.sign(upward[:, 2:])
    floor, top = triangles[..., 2].min(), triangles[..., 2].max()
    edges = flat[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2, 3)
    keys = np.rint(edges / _CORNER_M).astype(np.int64)
    # The same edge of two faces runs either way.
    swapped = (keys[:, 0] > keys[:, 1])[np.arange(len(keys)), (keys[:, 0] != keys[:, 1]).argmax(axis=1)]
    keys[swapped] = keys[swapped, ::-1]
    _, first, group, counts = np.unique(
        keys.reshape(-1, 6), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    means = np.zeros((len(first), 3))
    np.add.at(means, group.ravel(), np.repeat(upward, 3, axis=0))
    is_edge = (counts == 1) | (np.linalg.norm(means, axis=1) < _ONE_FACE * counts)
    start, end = edges[first[is_edge]].swapaxes(0, 1)
    run_m = np.linalg.norm(end - start, axis=1)
    shares = (0.5 * (start + end)[:, 2] - floor) / max(top - floor, 1e-6)
    kept = (run_m > _SHORTEST_M) & (shares > _FLOOR)
    return _sampled(start[kept], end[kept], run_m[kept], floor, top)


def _sampled(start: Floats, end: Floats, run_m: Floats, floor: float, top: float) -> Floats:
    step_m = max(_APART_M, float(run_m.sum()) / _MOST_OF_EDGES)
    counts = np.maximum(1, run_m / step_m).astype(np.int64)
    edge = np.repeat(np.arange(len(counts)), counts)
    along = (np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[edge]
    places = start[edge] + along[:, None] * (end - start)[edge]
    shares = (places[:, 2] - floor) / max(top - floor, 1e-6)
    return np.column_stack([places, shares, ((end - start) / np.maximum(run_m, 1e-9)[:, None])[edge]])
