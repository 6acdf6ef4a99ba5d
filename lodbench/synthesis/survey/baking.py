"""Surfaces painted on pictures: the ground from above, each face of a building on a rectangle of its own.

Texels are shaded where they lie in the world, in the light of one day.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.rendering.compiled import per_pixel, pixel_loop
from lodbench.synthesis.photo.kernel import Shading, flat_normal, out_of_crown, surface_light
from lodbench.synthesis.photo.noise import scaled
from lodbench.synthesis.photo.surfaces import surface_colour

Floats = NDArray[np.float64]

_GROUND_TEXEL_M, _FACE_TEXEL_M = 0.3, 0.2
# A face's rectangle is at least this large; smaller ones, panes and ledges, have one colour.
_LEAST_FACE_M2 = 4.0
_MARGIN = 2  # texels round a rectangle: a neighbour's do not bleed in where pictures are halved
_ATLAS_WIDTH = 2048


class Layout(NamedTuple):
    """Triangles on one picture."""

    triangle: NDArray[np.int64]  # (N,) their numbers
    # (N, 3, 2) float64 column and row of the corners, the picture's upper left corner being (0, 0).
    texels: Floats
    size: tuple[int, int]  # width and height of the picture
    texel_m: float  # size of a texel


def lay_out_ground(
    corners: Floats, triangle: NDArray[np.int64], square: tuple[float, float, float]
) -> Layout:
    """Returns ground triangles seen from above; those that reach out of the picture are left out.

    They are those with some numbers, (N,), of all corners, (T, 3, 3) metres. The picture's square is its west
    and south edges and its side, metres.
    """
    west, south, side = square
    texels = (corners[triangle, :, :2] - (west, south)) / _GROUND_TEXEL_M
    count = int(np.ceil(side / _GROUND_TEXEL_M))
    texels[..., 1] = count - texels[..., 1]
    inside = ((texels >= 1) & (texels <= count - 1)).all(axis=(1, 2))
    return Layout(triangle[inside], texels[inside], (count, count), _GROUND_TEXEL_M)


def lay_out_faces(corners: Floats, triangle: NDArray[np.int64], polygon: NDArray[np.int64]) -> Layout:
    """Returns the triangles of planar polygons, each polygon on a rectangle, packed in rows.

    They are those with some numbers, (N,), of all corners, (T, 3, 3) metres; those of one polygon, of which
    ``polygon``, (T,), tells, lie in a row. Small polygons are left out.
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


def baked(layout: Layout, corners: Floats, shading: Shading) -> NDArray[np.float32]:
    """Returns the (H, W, 3) linear RGB of a layout's picture; 0 where no triangle lies.

    Later triangles lie on earlier ones. Each is painted a texel further than it reaches, below all others.
    Corners, (T, 3, 3) metres, and shading are of all triangles.
    """
    width, height = layout.size
    light = np.zeros((height, width, 3), dtype=np.float32)
    for margin in (1.5, 0.0):
        _bake(layout.triangle, layout.texels, corners, layout.texel_m, margin, shading, light)
    return light


def corner_light(triangle: NDArray[np.int64], corners: Floats, shading: Shading) -> NDArray[np.float32]:
    """Returns the (N, 3, 3) linear RGB of the corners of some triangles; arguments as for ``baked``."""
    light = np.zeros((len(triangle), 3, 3), dtype=np.float32)
    _light_corners(triangle, corners, shading, light)
    return light


@per_pixel
def _surface_light(triangle, point, pixel_m, shading):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the linear RGB of a triangle at a point, looked at straight."""
    skin = shading.skin
    normal = flat_normal(skin, triangle)
    if skin.place[triangle, 6] > 0.0:
        # Leaves: light as round a crown, from outside of it.
        normal = out_of_crown(skin, triangle, point)
    albedo, _ = surface_colour(triangle, point, normal, pixel_m, shading)
    # What mirrors the sky looks different from everywhere: a map shows it dull.
    return surface_light(albedo, 0.0, point, normal, scaled(normal, -1.0), shading)


@pixel_loop
def _bake(triangles, texels, corners, texel_m, margin, shading, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Writes the light of texels within triangles; with a margin, of those up to so many texels outside."""
    height, width, _ = out.shape
    for k in range(len(triangles)):
        t = triangles[k]
        ax, ay = texels[k, 0, 0], texels[k, 0, 1]
        bx, by = texels[k, 1, 0] - ax, texels[k, 1, 1] - ay
        cx, cy = texels[k, 2, 0] - ax, texels[k, 2, 1] - ay
        area = bx * cy - by * cx
        if abs(area) < 1e-9:
            continue
        # What one texel across an edge changes of each barycentric coordinate.
        slope_b, slope_c = np.sqrt(cx * cx + cy * cy) / abs(area), np.sqrt(bx * bx + by * by) / abs(area)
        slope_a = np.sqrt((bx - cx) ** 2 + (by - cy) ** 2) / abs(area)
        left = max(0, np.int64(np.floor(ax + min(0.0, bx, cx) - margin)))
        right = min(width, np.int64(np.ceil(ax + max(0.0, bx, cx) + margin)))
        top = max(0, np.int64(np.floor(ay + min(0.0, by, cy) - margin)))
        bottom = min(height, np.int64(np.ceil(ay + max(0.0, by, cy) + margin)))
        for row in range(top, bottom):  # type: ignore[call-overload]
            for column in range(left, right):  # type: ignore[call-overload]
                dx, dy = column + 0.5 - ax, row + 0.5 - ay
                b, c = (dx * cy - dy * cx) / area, (bx * dy - by * dx) / area
                a = 1.0 - b - c
                if a < -margin * slope_a or b < -margin * slope_b or c < -margin * slope_c:
                    continue
                if margin > 0.0 and a >= 0.0 and b >= 0.0 and c >= 0.0:
                    continue
                x = a * corners[t, 0, 0] + b * corners[t, 1, 0] + c * corners[t, 2, 0]
                y = a * corners[t, 0, 1] + b * corners[t, 1, 1] + c * corners[t, 2, 1]
                z = a * corners[t, 0, 2] + b * corners[t, 1, 2] + c * corners[t, 2, 2]
                red, green, blue = _surface_light(t, (x, y, z), texel_m, shading)
                out[row, column, 0], out[row, column, 1], out[row, column, 2] = red, green, blue


@pixel_loop
def _light_corners(triangles, corners, shading, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Writes the light of triangles' corners."""
    for k in range(len(triangles)):
        t = triangles[k]
        for corner in range(3):
            point = (corners[t, corner, 0], corners[t, corner, 1], corners[t, corner, 2])
            red, green, blue = _surface_light(t, point, 0.5, shading)
            out[k, corner, 0], out[k, corner, 1], out[k, corner, 2] = red, green, blue
