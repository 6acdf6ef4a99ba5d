"""Textures for the raster: where each triangle lies on its picture, and looking a place up there.

With correct perspective, bilinear, and from pictures halved as often as the view is far (mip maps).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.mesh.textured import TexturedMesh
from lodbench.rendering.compiled import per_pixel

# A texture is halved so often at most, and not below this side.
_LEVELS, _LEAST_SIDE = 8, 4


class Charts(NamedTuple):
    """Where on its texture each triangle is, for the kernel.

    On a triangle, texture coordinates (or red, green and blue) are affine in the place in the world, so
    a look-up by the place is free of perspective errors.

    Attributes:
        slope: (T, 3, 3) float64: change of u and v, or of red, green and blue, per metre.
        start: (T, 3, 2) float64: of each, at the first corner; and that corner's coordinates.
        picture: (T,) int32 texture, or -1.
        texels: (N,) uint8 all textures at all sizes, RGB after RGB.
        offset: (P, levels) int64 where each begins.
        size: (P, levels, 2) int64 its width and height.
    """

    slope: NDArray[np.float64]
    start: NDArray[np.float64]
    picture: NDArray[np.int32]
    texels: NDArray[np.uint8]
    offset: NDArray[np.int64]
    size: NDArray[np.int64]


def make_charts(mesh: TexturedMesh | None) -> Charts:
    """Returns the charts of a mesh; of none, empty ones."""
    if mesh is None:
        empty = TexturedMesh(
            np.zeros((0, 3, 3)), np.zeros((0, 3, 2)), np.zeros(0, np.int32), np.zeros((0, 3, 3), np.uint8), ()
        )
        return make_charts(empty)
    values = np.concatenate([mesh.uv, np.zeros((len(mesh.uv), 3, 1))], axis=2)
    plain = mesh.picture < 0
    values[plain] = mesh.colours[plain]
    texels, offset, size = _pyramids(mesh.pictures)
    start = np.stack([values[:, 0], mesh.corners[:, 0]], axis=2)
    return Charts(_slopes(mesh.corners, values), start, mesh.picture.astype(np.int32), texels, offset, size)


def _slopes(corners: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns (T, 3, 3) gradients within each triangle's plane of three values given at its corners."""
    e, g = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    ee, eg, gg = (np.einsum("tx,tx->t", a, b) for a, b in ((e, e), (e, g), (g, g)))
    determinant = ee * gg - eg * eg
    scale = np.where(determinant > 0, 1.0 / np.where(determinant > 0, determinant, 1.0), 0.0)
    # Rows that give the two barycentric coordinates of a place.
    first = (e * gg[:, None] - g * eg[:, None]) * scale[:, None]
    second = (g * ee[:, None] - e * eg[:, None]) * scale[:, None]
    change_e, change_g = values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]
    return np.asarray(change_e[:, :, None] * first[:, None] + change_g[:, :, None] * second[:, None])


def _pyramids(
    pictures: tuple[NDArray[np.uint8], ...],
) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]:
    """Returns the texels of all textures, each halved again and again, and where they are."""
    flat, begin = [np.zeros(3, dtype=np.uint8)], 3
    offset = np.zeros((len(pictures), _LEVELS), dtype=np.int64)
    size = np.zeros((len(pictures), _LEVELS, 2), dtype=np.int64)
    for number, picture in enumerate(pictures):
        level_picture = picture
        for level in range(_LEVELS):
            height, width = level_picture.shape[:2]
            if level and min(height, width) >= 2 * _LEAST_SIDE:
                height, width = height // 2, width // 2
                halved = cv2.resize(level_picture, (width, height), interpolation=cv2.INTER_AREA)
                level_picture = np.asarray(halved, dtype=np.uint8)
            elif level:
                offset[number, level], size[number, level] = offset[number, level - 1], (width, height)
                continue
            flat.append(np.ascontiguousarray(level_picture).ravel())
            offset[number, level], size[number, level] = begin, (width, height)
            begin += flat[-1].size
    return np.concatenate(flat), offset, size


@per_pixel
def texture_light(row, x, y, z, pixel_m, charts):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the linear RGB of a textured triangle at a point; arguments as for ``texture_colour``."""
    red, green, blue = texture_colour(row, x, y, z, pixel_m, charts)
    scale = 1.0 / 65025.0
    return red * red * scale, green * green * scale, blue * blue * scale


@per_pixel
def texture_colour(row, x, y, z, pixel_m, charts):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the RGB of a textured triangle at a point, 0 to 255.

    Args:
        row: Of the triangle in the charts.
        x: Point, east, local metres.
        y: North.
        z: Up.
        pixel_m: Size of a pixel there.
        charts: Charts.
    """
    start, slope = charts.start, charts.slope
    dx, dy, dz = x - start[row, 0, 1], y - start[row, 1, 1], z - start[row, 2, 1]
    a = start[row, 0, 0] + slope[row, 0, 0] * dx + slope[row, 0, 1] * dy + slope[row, 0, 2] * dz
    b = start[row, 1, 0] + slope[row, 1, 0] * dx + slope[row, 1, 1] * dy + slope[row, 1, 2] * dz
    picture = charts.picture[row]
    if picture < 0:
        c = start[row, 2, 0] + slope[row, 2, 0] * dx + slope[row, 2, 1] * dy + slope[row, 2, 2] * dz
        return a, b, c
    # The coarser direction decides the size of the texture to look at.
    across = np.sqrt(slope[row, 0, 0] ** 2 + slope[row, 0, 1] ** 2 + slope[row, 0, 2] ** 2)
    along = np.sqrt(slope[row, 1, 0] ** 2 + slope[row, 1, 1] ** 2 + slope[row, 1, 2] ** 2)
    texels = pixel_m * max(across * charts.size[picture, 0, 0], along * charts.size[picture, 0, 1])
    level = 0
    while texels > 1.5 and level < charts.size.shape[1] - 1:
        texels *= 0.5
        level += 1
    width, height = charts.size[picture, level, 0], charts.size[picture, level, 1]
    begin = charts.offset[picture, level]
    u, v = (a - np.floor(a)) * width - 0.5, (1.0 - (b - np.floor(b))) * height - 0.5
    i, j = np.int64(np.floor(u)), np.int64(np.floor(v))
    fu, fv = u - i, v - j
    red = green = blue = 0.0
    for k in range(4):
        column, line = (i + (k & 1)) % width, (j + (k >> 1)) % height
        weight = (fu if k & 1 else 1.0 - fu) * (fv if k >> 1 else 1.0 - fv)
        place = begin + 3 * (line * width + column)
        red += weight * charts.texels[place]
        green += weight * charts.texels[place + 1]
        blue += weight * charts.texels[place + 2]
    return red, green, blue
