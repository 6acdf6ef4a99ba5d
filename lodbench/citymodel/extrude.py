"""Footprints to blocks: floor, flat roof and walls, holes included, faces outward."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import SurfaceKind
from lodbench.citymodel.raw import starts_of, take_segments


@dataclass(frozen=True, slots=True)
class Blocks:
    """Extruded footprints, flat: floors, then roofs, then walls.

    Attributes:
        points: (P, 3) float64.
        ring_lengths: (R,) int64.
        ring_counts: (N,) int64.
        footprint: (N,) int64 which footprint each polygon comes from.
        kind: (N,) uint8.
    """

    points: NDArray[np.float64]
    ring_lengths: NDArray[np.int64]
    ring_counts: NDArray[np.int64]
    footprint: NDArray[np.int64]
    kind: NDArray[np.uint8]


def extrude(
    points: NDArray[np.float64],
    ring_starts: NDArray[np.int64],
    polygon_starts: NDArray[np.int64],
    bottom: NDArray[np.float64],
    top: NDArray[np.float64],
) -> Blocks:
    """Returns blocks over footprints.

    Args:
        points: (P, 2) float64, x east, y north; rings of three points or more, not closed.
        ring_starts: (R + 1,) offsets into ``points``.
        polygon_starts: (N + 1,) offsets into the rings; the first ring is the outline.
        bottom: (N,) height of each floor.
        top: (N,) height of each roof.
    """
    points = _orient(points, ring_starts, polygon_starts)
    ring_lengths, ring_counts = np.diff(ring_starts), np.diff(polygon_starts)
    count = len(ring_counts)
    ring_polygon = np.repeat(np.arange(count), ring_counts)
    point_ring = np.repeat(np.arange(len(ring_lengths)), ring_lengths)
    low, high = bottom[ring_polygon[point_ring]], top[ring_polygon[point_ring]]
    floors = np.column_stack([points, low])[_reversed_order(ring_starts)]
    roofs = np.column_stack([points, high])
    following = np.arange(len(points)) + 1
    following[ring_starts[1:] - 1] = ring_starts[:-1]
    walls = np.stack(
        [
            np.column_stack([points, low]),
            np.column_stack([points[following], low]),
            np.column_stack([points[following], high]),
            np.column_stack([points, high]),
        ],
        axis=1,
    ).reshape(-1, 3)
    kinds = (SurfaceKind.GROUND, SurfaceKind.ROOF, SurfaceKind.WALL)
    return Blocks(
        points=np.concatenate([floors, roofs, walls]),
        ring_lengths=np.concatenate([ring_lengths, ring_lengths, np.full(len(points), 4)]),
        ring_counts=np.concatenate([ring_counts, ring_counts, np.ones(len(points), np.int64)]),
        footprint=np.concatenate([np.arange(count), np.arange(count), ring_polygon[point_ring]]),
        kind=np.repeat(np.array(kinds, np.uint8), [count, count, len(points)]),
    )


def ring_areas(points: NDArray[np.float64], ring_starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Returns the signed areas of plane rings, positive counter-clockwise."""
    if len(ring_starts) < 2:
        return np.zeros(0)
    local = points - np.repeat(points[ring_starts[:-1]], np.diff(ring_starts), axis=0)
    following = np.roll(local, -1, axis=0)
    following[ring_starts[1:] - 1] = 0.0
    cross = local[:, 0] * following[:, 1] - local[:, 1] * following[:, 0]
    areas: NDArray[np.float64] = 0.5 * np.add.reduceat(cross, ring_starts[:-1])
    return areas


def _orient(
    points: NDArray[np.float64], ring_starts: NDArray[np.int64], polygon_starts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Returns the points with outlines counter-clockwise and holes clockwise."""
    is_outline = np.zeros(len(ring_starts) - 1, np.bool_)
    is_outline[polygon_starts[:-1]] = True
    is_wrong = (ring_areas(points, ring_starts) > 0) != is_outline
    order = np.arange(len(points))
    wrong = np.flatnonzero(is_wrong)
    items, _ = take_segments(ring_starts, wrong)
    order[items] = _reversed_order(ring_starts)[items]
    return points[order]


def _reversed_order(ring_starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns, for each point, the one that takes its place when its ring is turned round."""
    ring = np.repeat(np.arange(len(ring_starts) - 1), np.diff(ring_starts))
    reversed_order: NDArray[np.int64] = ring_starts[ring] + ring_starts[ring + 1] - 1 - np.arange(len(ring))
    return reversed_order


def clean_rings(
    rings: list[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Returns rings without closing and repeated points: points (P, 2), starts, repeats per ring."""
    lengths = np.asarray([len(ring) for ring in rings], np.int64)
    points = np.concatenate(rings)[:, :2] if rings else np.zeros((0, 2))
    starts = starts_of(lengths)
    ring = np.repeat(np.arange(len(lengths)), lengths)
    following = np.arange(len(points)) + 1
    filled = lengths > 0
    following[starts[1:][filled] - 1] = starts[:-1][filled]
    # A point equal to the next of its ring goes; that takes the closing point, too.
    kept = np.any(points != points[following], axis=1) if len(points) else np.zeros(0, np.bool_)
    new_lengths = np.bincount(ring[kept], minlength=len(lengths))
    repeats = lengths - new_lengths - 1
    return points[kept], starts_of(new_lengths), np.maximum(repeats, 0)
