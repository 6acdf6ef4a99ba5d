"""Textures for the raster: where each triangle lies on its picture, and looking a place up there.

With correct perspective, bilinear, and from pictures halved as often as the view is far (mip maps).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.mesh.textured import TexturedMesh
from lodbench.kernels.looks import Charts

# A texture is halved so often at most, and not below this side.
_LEVELS, _LEAST_SIDE = 8, 4


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
