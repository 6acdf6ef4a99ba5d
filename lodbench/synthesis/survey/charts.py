"""Surfaces laid out on pictures: the ground from above, each face of a building on a rectangle of its own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_GROUND_TEXEL_M, _FACE_TEXEL_M = 0.3, 0.2
# A face's rectangle is at least this large; smaller ones, panes and ledges, have one colour.
_LEAST_FACE_M2 = 4.0
_MARGIN = 2  # texels round a rectangle: a neighbour's do not bleed in where pictures are halved
_ATLAS_WIDTH = 2048


class Layout(NamedTuple):
    """Triangles on one picture.

    Attributes:
        triangle: (N,) their numbers.
        texels: (N, 3, 2) float64 column and row of the corners, the picture's upper left corner being (0, 0).
        size: Width and height of the picture.
        texel_m: Size of a texel.
    """

    triangle: NDArray[np.int64]
    texels: Floats
    size: tuple[int, int]
    texel_m: float


def lay_out_ground(
    corners: Floats, triangle: NDArray[np.int64], square: tuple[float, float, float]
) -> Layout:
    """Returns ground triangles seen from above; those that reach out of the picture are left out.

    Args:
        corners: (T, 3, 3) of all triangles, metres.
        triangle: (N,) numbers of those of the ground in a square.
        square: West and south edges of the picture, and its side, metres.
    """
    west, south, side = square
    texels = (corners[triangle, :, :2] - (west, south)) / _GROUND_TEXEL_M
    count = int(np.ceil(side / _GROUND_TEXEL_M))
    texels[..., 1] = count - texels[..., 1]
    inside = ((texels >= 1) & (texels <= count - 1)).all(axis=(1, 2))
    return Layout(triangle[inside], texels[inside], (count, count), _GROUND_TEXEL_M)


def lay_out_faces(corners: Floats, triangle: NDArray[np.int64], polygon: NDArray[np.int64]) -> Layout:
    """Returns the triangles of planar polygons, each polygon on a rectangle, packed in rows.

    Args:
        corners: (T, 3, 3) of all triangles, metres.
        triangle: (N,) numbers of those to lay out, those of one polygon in a row.
        polygon: (T,) polygon of each triangle; small ones are left out.
    """
    starts = np.flatnonzero(np.diff(polygon[triangle], prepend=-1))
    own = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(triangle))))
    flat = _on_plane(corners[triangle], starts, own)
    low, high = np.full((len(starts), 2), np.inf), np.full((len(starts), 2), -np.inf)
    np.minimum.at(low, own, flat.min(axis=1))
    np.maximum.at(high, own, flat.max(axis=1))
    side_m = np.minimum(high - low, (_ATLAS_WIDTH - 4 * _MARGIN) * _FACE_TEXEL_M)
    sides = np.ceil(side_m / _FACE_TEXEL_M).astype(np.int64) + 2 * _MARGIN
    is_large = side_m.prod(axis=1) >= _LEAST_FACE_M2
    places, height = _packed(sides[is_large])
    place = np.zeros((len(starts), 2), dtype=np.int64)
    place[is_large] = places
    texels = (flat - low[own, None]) / _FACE_TEXEL_M + (place + _MARGIN)[own, None]
    kept = is_large[own]
    return Layout(triangle[kept], texels[kept], (_ATLAS_WIDTH, height), _FACE_TEXEL_M)


def _on_plane(corners: Floats, starts: NDArray[np.int64], own: NDArray[np.int64]) -> Floats:
    """Returns (N, 3, 2) metres along two axes of each polygon's plane, the first of them level."""
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.add.reduceat(areas, starts, axis=0)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    is_level = np.abs(normal[:, 2]) > 0.999
    level = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)
    level[is_level] = 1.0, 0.0, 0.0
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    steep = np.cross(level, normal)
    axes = np.stack([level, steep], axis=1)[own]
    return np.asarray(np.einsum("nax,ncx->nca", axes, corners))


def _packed(sides: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Returns upper left corners of rectangles, (N, 2), in rows of falling height, and the height of all."""
    places = np.zeros_like(sides)
    column = row = tallest = 0
    for k in np.argsort(-sides[:, 1], kind="stable"):
        width, height = sides[k]
        if column + width > _ATLAS_WIDTH:
            column, row, tallest = 0, row + tallest, 0
        places[k] = column, row
        column, tallest = column + width, max(tallest, height)
    return places, int(row + tallest)
