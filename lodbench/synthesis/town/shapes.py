"""Plane geometry of the town: rings of corners, (N, 2) metres, counter-clockwise unless said."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

Points = NDArray[np.float64]


def area(ring: Points) -> float:
    """Returns the signed area, positive when counter-clockwise."""
    x, y = ring[:, 0], ring[:, 1]
    return 0.5 * float(np.sum(x * _ahead(y) - _ahead(x) * y))


def edge_directions(ring: Points) -> Points:
    """Returns the unit direction of each edge, (N, 2), from a corner to the next."""
    edges = _ahead(ring) - ring
    return np.asarray(edges / np.linalg.norm(edges, axis=1, keepdims=True))


def edge_lengths(ring: Points) -> Points:
    """Returns the length of each edge, (N,), from a corner to the next."""
    return np.asarray(np.linalg.norm(_ahead(ring) - ring, axis=1))


def _ahead(ring: Points) -> Points:
    """Returns for each corner the next; ``np.roll`` takes several times as long for so few."""
    return np.concatenate([ring[1:], ring[:1]])


def left_of(direction: Points) -> Points:
    """Returns directions, (..., 2), turned by 90 degrees to the left."""
    turned = np.empty_like(direction)
    turned[..., 0], turned[..., 1] = -direction[..., 1], direction[..., 0]
    return turned


def cut(ring: Points, point: Points, inward: Points) -> Points:
    """Returns the part of a convex ring on the inward side of a line through a point; may be empty."""
    side = (ring - point) @ inward
    kept: list[Points] = []
    for k in range(len(ring)):
        here, ahead = side[k], side[(k + 1) % len(ring)]
        if here >= 0:
            kept.append(ring[k])
        if here * ahead < 0:
            kept.append(ring[k] + (ring[(k + 1) % len(ring)] - ring[k]) * (here / (here - ahead)))
    return np.array(kept).reshape(-1, 2)


def parallel(line: Points, distances: Points, *, closed: bool) -> Points:
    """Returns a polyline, (K, 2), moved to its left, each segment by its own distance, with mitred corners.

    There are K - 1 distances, or K of a closed ring, whose last corner joins the first.
    """
    along = edge_directions(line)
    left = left_of(along)
    moved = np.empty_like(line)
    for k in range(len(line)):
        if not closed and k == 0:
            moved[k] = line[k] + left[0] * distances[0]
        elif not closed and k == len(line) - 1:
            moved[k] = line[k] + left[k - 1] * distances[k - 1]
        else:
            normals = np.stack([left[k - 1], left[k]])
            moved[k] = line[k] + np.linalg.solve(normals, np.array([distances[k - 1], distances[k]]))
    return moved


def inset(ring: Points, distance: float) -> Points | None:
    """Returns a ring shrunk by a distance with the same corners, or None where an edge would vanish."""
    inner = parallel(ring, np.full(len(ring), distance), closed=True)
    edges = _ahead(inner) - inner
    lengths = np.sum(edges * edge_directions(ring), axis=1)
    return inner if lengths.min() > 1.0 and area(inner) > 0 else None


def corner_angles_deg(ring: Points) -> Points:
    """Returns the inner angle at each corner, (N,), degrees."""
    out = edge_directions(ring)
    into = np.roll(out, 1, axis=0)
    turn = np.arctan2(into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0], np.sum(into * out, axis=1))
    return np.asarray(180.0 - np.degrees(turn))


def contains(ring: Points, points: Points) -> NDArray[np.bool_]:
    """Returns which points, (M, 2), lie inside a ring of any shape."""
    return np.asarray(shapely.contains_xy(shapely.Polygon(ring), points))


def keeps_apart(a: Points, b: Points, gap_m: float) -> bool:
    """Returns whether some edge of two convex rings separates them by at least a gap."""
    for first, second in ((a, b), (b, a)):
        outward = -left_of(edge_directions(first))
        distance = np.einsum("kc,kmc->km", outward, second[None, :, :] - first[:, None, :]).min(axis=1)
        if distance.max() >= gap_m - 1e-9:
            return True
    return False


def box_of(ring: Points) -> tuple[Points, float, float]:
    """Returns the direction, length and width of the smallest box around a ring, along one of its edges."""
    axes = [np.stack([along, left_of(along)]) for along in edge_directions(ring)]
    spans = [np.ptp(ring @ pair.T, axis=0).tolist() for pair in axes]
    # Boxes along parallel edges differ by what floats round: the first of them is taken.
    least = min(range(len(axes)), key=lambda k: round(spans[k][0] * spans[k][1], 6))
    (along, across), (length, width) = axes[least], spans[least]
    return (along, length, width) if length >= width else (across, width, length)


def rectangles(middle: Points, along: Points, length: float, width: float) -> Points:
    """Returns rectangles, (..., 4, 2), counter-clockwise, around middles, (..., 2), along unit directions."""
    u, v = 0.5 * length * along, 0.5 * width * left_of(along)
    return np.stack([middle - u - v, middle + u - v, middle + u + v, middle - u + v], axis=-2)


def offset_line(line: Points, distance: float) -> Points:
    """Returns a polyline, (K, 2), moved to its left."""
    way = np.gradient(line, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return np.asarray(line + distance * left_of(way))


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
