"""Edges of roofs in photos: at a roof's true height its eaves and ridges lie on edges of all that show them.

Roofs of one colour look alike at every height within them (``roof_sweep``); where they end they do not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.methods.flight.sweep_pictures import SweepPicture

Floats = NDArray[np.float64]

# Edges are sampled no closer than this, metres, in so many points at most; shorter ones are left out.
_SPACING_M, _MOST_POINTS, _SHORTEST_M = 0.5, 160, 0.3
# Corners are the same within this, metres.
_CORNER_M = 0.01
# Faces steeper than this are walls: the upward part of their unit normal. Two that turn by less are one face:
# the length of their normals' mean.
_FLAT, _ONE_FACE = 0.3, 0.992
# What lies lower than this share of a building's height is its floor.
_FLOOR = 0.1
# Colours L, a, b count so much; edges within so many pixels are one.
_WEIGHTS, _BLUR_PX = (1.0, 2.0, 2.0), 1.0
# Strengths are shares of the photo's mean; so much is added, for edges that a photo does not have.
_ADDED = 0.5
# Points of one roof err together: N say as much as _ALONE * sqrt(N) of them, and no more than so many do.
_ALONE, _MOST_SEEN = 0.6, 2000


class EdgeEvidence(NamedTuple):
    """How strong a roof's edges are in photos, by its height.

    Attributes:
        logs: (H,) sums of logarithms over points and photos.
        seen: How many points of all photos were summed.
        photos: How many photos.
    """

    logs: Floats
    seen: int
    photos: int

    def nats(self) -> Floats:
        """Returns (H,) how well each height explains the photos."""
        return np.asarray(_ALONE * math.sqrt(min(self.seen, _MOST_SEEN)) * self.logs / self.seen)


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
    step_m = max(_SPACING_M, float(run_m.sum()) / _MOST_POINTS)
    counts = np.maximum(1, run_m / step_m).astype(np.int64)
    edge = np.repeat(np.arange(len(counts)), counts)
    along = (np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[edge]
    places = start[edge] + along[:, None] * (end - start)[edge]
    shares = (places[:, 2] - floor) / max(top - floor, 1e-6)
    return np.column_stack([places, shares, ((end - start) / np.maximum(run_m, 1e-9)[:, None])[edge]])


def edge_evidence(
    pictures: Sequence[SweepPicture],
    near: Sequence[NDArray[np.int64]],
    edges: Mapping[int, Floats],
    is_seen_of: Sequence[NDArray[np.bool_]],
    heights_m: Floats,
) -> dict[int, EdgeEvidence]:
    """Returns how strong edges are in the photos that show them, by row of the building.

    Args:
        pictures: The photos.
        near: By photo, rows of the buildings whose edges are looked at in it.
        edges: Their points, see ``edge_points``.
        is_seen_of: By photo, which of the points of all its buildings it shows, one after the other.
        heights_m: (H,) by how much higher than in the map a building may be.
    """
    found: dict[int, EdgeEvidence] = {}
    for picture, rows, is_seen in zip(pictures, near, is_seen_of, strict=True):
        if not is_seen.any():
            continue
        points = np.concatenate([edges[row] for row in rows.tolist()])[is_seen]
        owner = np.repeat(np.arange(len(rows)), [len(edges[row]) for row in rows.tolist()])[is_seen]
        logs = _log_strengths(picture, points, heights_m)
        first = np.flatnonzero(np.r_[True, owner[1:] != owner[:-1]])
        for k, summed in zip(owner[first], np.add.reduceat(logs, first, axis=1).T, strict=True):
            count = int(np.count_nonzero(owner == k))
            before = found.get(int(rows[k]), EdgeEvidence(np.zeros(len(heights_m)), 0, 0))
            found[int(rows[k])] = EdgeEvidence(before.logs + summed, before.seen + count, before.photos + 1)
    return found


def _log_strengths(picture: SweepPicture, points: Floats, heights_m: Floats) -> Floats:
    """Returns (H, N) logarithms of how strong a photo's edges along (N, 7) points are, shares of its mean."""
    tensor, mean = _structure(picture.pixels)
    raised = points[:, :3] + heights_m[:, None, None] * points[:, 3:4] * [0.0, 0.0, 1.0]
    pixels = (picture.project(raised)[0] - 0.5).astype(np.float32)
    run = picture.project(points[:, :3] + 0.05 * points[:, 4:])[0] - picture.project(points[:, :3])[0]
    column, line = (run / np.maximum(np.linalg.norm(run, axis=1, keepdims=True), 1e-12)).T
    # OpenCV takes maps of no more than 32,767 columns.
    parts = np.split(pixels, range(32_000, pixels.shape[1], 32_000), axis=1)
    at = np.concatenate([cv2.remap(tensor, p[..., 0], p[..., 1], cv2.INTER_LINEAR) for p in parts], axis=1)
    # Across the edge.
    square = line**2 * at[..., 0] - 2.0 * line * column * at[..., 1] + column**2 * at[..., 2]
    return np.asarray(np.log(np.sqrt(np.maximum(square, 0.0)) / mean + _ADDED))


def _structure(pixels: NDArray[np.uint8]) -> tuple[NDArray[np.float32], float]:
    """Returns the structure tensor (H, W, 3) xx, xy, yy of the colours, and the mean strength of edges.

    Foerstner and Guelch, "A fast operator for detection and precise location of distinct points, corners and
    centres of circular features", 1987.
    """
    tensor = np.zeros((*pixels.shape[:2], 3), np.float32)
    for channel, weight in enumerate(_WEIGHTS):
        colour = np.ascontiguousarray(pixels[..., channel])
        right, down = (cv2.Scharr(colour, cv2.CV_32F, *axis) * (weight / 32.0) for axis in ((1, 0), (0, 1)))
        tensor += np.stack([right * right, right * down, down * down], axis=-1)
    tensor = np.asarray(cv2.GaussianBlur(tensor, (0, 0), _BLUR_PX), np.float32)
    return tensor, max(float(np.sqrt(tensor[..., 0] + tensor[..., 2]).mean()), 1e-3)
