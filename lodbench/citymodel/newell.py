"""Polygons in space as plane figures: normals, areas, and how they look along their normal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import Polygons

# What is narrower is a line: there and back by rounding.
_LINE_M = 1e-3


def newell(polygons: Polygons) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the outlines' Newell vectors (N, 3), of twice their area, and the areas less holes (N,)."""
    points, starts = polygons.points, polygons.ring_starts
    lengths = np.diff(starts)
    if len(lengths) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    relative = points - np.repeat(points[starts[:-1]], lengths, axis=0)
    following = np.concatenate([relative[1:], relative[:1]])
    following[starts[1:] - 1] = 0.0  # the first point of each ring, relative to itself
    ring_vectors = np.add.reduceat(np.cross(relative, following), starts[:-1], axis=0)
    ring_areas = 0.5 * np.linalg.norm(ring_vectors, axis=1)
    outlines = polygons.polygon_starts[:-1]
    total = np.add.reduceat(ring_areas, outlines)
    return ring_vectors[outlines], np.maximum(2.0 * ring_areas[outlines] - total, 0.0)


def enclosed_area(ring: NDArray[np.float64]) -> float:
    """Returns what a ring, (n, 3), goes round in its mean plane: of a bow tie both halves, of a line nothing.

    Newell's area of a symmetric bow tie is nothing either, for its halves run opposite ways.
    """
    centred = ring - ring.mean(axis=0)
    _, lengths, axes = np.linalg.svd(centred, full_matrices=False)
    if lengths[1] <= _LINE_M:
        return 0.0
    import shapely

    edges = shapely.unary_union(shapely.linearrings(centred @ axes[:2].T))
    area = float(shapely.area(shapely.polygonize(shapely.get_parts(edges))))
    return area if area > _LINE_M * shapely.length(edges) else 0.0


def points_per_polygon(polygons: Polygons) -> NDArray[np.int64]:
    """Returns (N,) corners of each polygon, those of its holes included."""
    return np.diff(polygons.ring_starts[polygons.polygon_starts])


def local_points(polygons: Polygons) -> NDArray[np.float64]:
    """Returns the points with each polygon's first point as its origin."""
    first = polygons.ring_starts[polygons.polygon_starts[:-1]]
    return polygons.points - np.repeat(polygons.points[first], points_per_polygon(polygons), axis=0)


def project(
    local: NDArray[np.float64], unit: NDArray[np.float64], point_counts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Returns (P, 2) points seen against each polygon's normal, outlines counter-clockwise.

    The exact normal matters: seen along the nearest axis instead, a narrow polygon that is bent by
    a millimetre can fold over itself.
    """
    helper = np.eye(3)[np.argmin(np.abs(unit), axis=1)]
    across = np.cross(helper, unit)
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-300)[:, None]
    frames = np.stack([across, np.cross(unit, across)], axis=2)
    plane: NDArray[np.float64] = np.einsum("pi,pij->pj", local, np.repeat(frames, point_counts, axis=0))
    return plane


def deviation(
    polygons: Polygons,
    local: NDArray[np.float64],
    unit: NDArray[np.float64],
    point_counts: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Returns each polygon's largest corner distance from the plane through its mean point, metres."""
    if len(polygons) == 0:
        return np.zeros(0)
    height = np.einsum("ij,ij->i", local, np.repeat(unit, point_counts, axis=0))
    first = polygons.ring_starts[polygons.polygon_starts[:-1]]
    mean = np.add.reduceat(height, first) / point_counts
    return np.maximum.reduceat(np.abs(height - np.repeat(mean, point_counts)), first)
