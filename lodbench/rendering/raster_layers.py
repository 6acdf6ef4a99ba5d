"""From a z-buffer to the layers people use: depth, ids, normals, colour, one band at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray


class Planes(NamedTuple):
    """The arrays of ``Layers``, for the kernel."""

    depth: NDArray[np.float32]
    building: NDArray[np.int32]
    triangle: NDArray[np.int32]
    normal: NDArray[np.float32]
    colour: NDArray[np.uint8]


def blank_planes(width: int, height: int) -> Planes:
    """Returns room for every layer of a view; the values are yet to be written."""
    return Planes(
        np.empty((height, width), dtype=np.float32),
        np.empty((height, width), dtype=np.int32),
        np.empty((height, width), dtype=np.int32),
        np.empty((height, width, 3), dtype=np.float32),
        np.empty((height, width, 3), dtype=np.uint8),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _facing_normal(mesh, triangle, center):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns a triangle's unit normal on the side of a point, or zeros if it has no area."""
    i, j, k = mesh.triangles[triangle]
    a, b, c = mesh.vertices[i], mesh.vertices[j], mesh.vertices[k]
    e0, e1, e2 = np.float64(b[0]) - a[0], np.float64(b[1]) - a[1], np.float64(b[2]) - a[2]
    g0, g1, g2 = np.float64(c[0]) - a[0], np.float64(c[1]) - a[1], np.float64(c[2]) - a[2]
    x, y, z = e1 * g2 - e2 * g1, e2 * g0 - e0 * g2, e0 * g1 - e1 * g0
    length = np.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return 0.0, 0.0, 0.0
    towards = x * (center[0] - a[0]) + y * (center[1] - a[1]) + z * (center[2] - a[2])
    scale = 1.0 / length if towards >= 0.0 else -1.0 / length
    return x * scale, y * scale, z * scale


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(appearance, building, x, y, z):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the RGB of a building's surface of a given normal: Lambert's law and ambient light."""
    # Neighbours in the file are neighbours on the ground: a hash keeps them from looking alike.
    number = (building * 2654435761 >> 8) & 0xFFFF
    table = appearance.roofs if abs(z) > 0.3 else appearance.walls
    rgb = table[number % table.shape[0]]
    sun = appearance.sun
    light = appearance.ambient + (1.0 - appearance.ambient) * max(0.0, x * sun[0] + y * sun[1] + z * sun[2])
    return np.uint8(rgb[0] * light), np.uint8(rgb[1] * light), np.uint8(rgb[2] * light)


@njit(cache=True, nogil=True, error_model="numpy")
def resolve_depth(band, buffer, depth):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Writes a band's columns of (H, W) float32 depth."""
    for row in range(band.height):
        for column in range(band.first, band.stop):
            inverse = buffer.inverse[column - band.first, row]
            depth[row, column] = 1.0 / inverse if inverse > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def resolve_normals(mesh, center, band, buffer, normal):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Writes a band's columns of (H, W, 3) float32 normals."""
    known = np.int32(-1)
    nx = ny = nz = 0.0
    for row in range(band.height):
        for column in range(band.first, band.stop):
            triangle = buffer.winner[column - band.first, row]
            if triangle != known:
                known = triangle
                nx = ny = nz = 0.0
                if triangle >= 0:
                    nx, ny, nz = _facing_normal(mesh, triangle, center)
            normal[row, column, 0], normal[row, column, 1], normal[row, column, 2] = nx, ny, nz


@njit(cache=True, nogil=True, error_model="numpy")
def resolve_buildings(mesh, band, buffer, building):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Writes a band's columns of (H, W) int32 indices of buildings, -1 for none."""
    known, number = np.int32(-1), np.int64(-1)
    for row in range(band.height):
        for column in range(band.first, band.stop):
            triangle = buffer.winner[column - band.first, row]
            if triangle != known:
                known, number = triangle, np.int64(-1)
                if triangle >= 0:
                    number = np.searchsorted(mesh.triangle_starts, triangle, side="right") - 1
            building[row, column] = number


@njit(cache=True, nogil=True, error_model="numpy")
def resolve_layers(mesh, appearance, center, band, buffer, planes):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Writes a band's columns of every layer.

    Pixels of a row mostly repeat their left neighbour's triangle, so what belongs to a triangle is
    worked out when it changes.
    """
    resolve_depth(band, buffer, planes.depth)
    known, building = np.int32(-1), np.int64(-1)
    nx = ny = nz = 0.0
    red, green, blue = appearance.background[0], appearance.background[1], appearance.background[2]
    for row in range(band.height):
        for column in range(band.first, band.stop):
            triangle = buffer.winner[column - band.first, row]
            if triangle != known:
                known, building = triangle, np.int64(-1)
                nx = ny = nz = 0.0
                red, green, blue = appearance.background
                if triangle >= 0:
                    building = np.searchsorted(mesh.triangle_starts, triangle, side="right") - 1
                    nx, ny, nz = _facing_normal(mesh, triangle, center)
                    red, green, blue = _shade(appearance, building, nx, ny, nz)
            planes.triangle[row, column], planes.building[row, column] = triangle, building
            planes.normal[row, column, 0] = nx
            planes.normal[row, column, 1] = ny
            planes.normal[row, column, 2] = nz
            planes.colour[row, column, 0] = red
            planes.colour[row, column, 1] = green
            planes.colour[row, column, 2] = blue
