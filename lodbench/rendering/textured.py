"""Pictures of a textured map by the raster: as its textures are, without sun, haze or a camera's faults."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.citymodel.textured_map import TexturedMesh
from lodbench.geometry import Camera
from lodbench.kernels import resolve_textured
from lodbench.kernels.arguments import Band, Buffer
from lodbench.kernels.looks import Charts
from lodbench.rendering.raster import RasterRenderer, plain_appearance

Floats = NDArray[np.float64]

# Triangles are drawn in groups by squares of the plan: small, so that few are projected in vain.
_CELL_M = 32.0


def triangle_groups(corners: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns an order of (T, 3, 3) triangles by squares of the plan, and where each square's begin."""
    middle = corners[:, :, :2].mean(axis=1)
    cell = np.floor((middle - middle.min(axis=0)) / _CELL_M).astype(np.int64)
    key = cell[:, 1] * (int(cell[:, 0].max()) + 1) + cell[:, 0]
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    return order, np.append(starts, len(order))


def grouped_scene(corners: Floats, starts: NDArray[np.int64]) -> Scene:
    """Returns grouped triangles as a scene; every group has vertices of its own."""
    count = len(starts) - 1
    group = np.repeat(np.arange(count), 3 * np.diff(starts))
    points = corners.reshape(-1, 3).astype(np.float32)
    # Several times as fast as unique rows of a structured array.
    order = np.lexsort((points[:, 2], points[:, 1], points[:, 0], group))
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = (np.diff(group[order]) != 0) | (points[order[1:]] != points[order[:-1]]).any(axis=1)
    first, triangles = order[is_new], np.empty(len(order), dtype=np.int32)
    triangles[order] = np.cumsum(is_new) - 1
    return Scene(
        vertices=points[first],
        triangles=triangles.reshape(-1, 3),
        vertex_starts=np.searchsorted(group[first], np.arange(count + 1)).astype(np.int64),
        triangle_starts=starts.astype(np.int64),
        building_ids=tuple(str(number) for number in range(count)),
        lod="",
        crs=None,
        origin=np.zeros(3),
    )


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


# The mesh is of many small triangles.
_BAND = 256


class TexturedRenderer:
    """Renders a textured mesh: the nearest triangle of two by two samples per pixel, then its texture.

    Args:
        mesh: In the scene's local metric frame.
        threads: Worker threads; None for one per core.
    """

    def __init__(self, mesh: TexturedMesh, threads: int | None = None) -> None:
        order, starts = triangle_groups(mesh.corners)
        self._charts = make_charts(mesh.in_order(order))
        self._raster = RasterRenderer(grouped_scene(mesh.corners[order], starts), threads, band=_BAND)
        self._background = tuple(float(value) for value in plain_appearance().background)

    def colours(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.uint8]:
        """Returns (N, H, W, 3) RGB pictures of N views; pale where there is nothing.

        Args:
            camera: Pinhole of all views, at most 4096 pixels wide and high.
            rotations: (N, 3, 3) cam_from_world.
            centers: (N, 3) camera centres, local metres.

        Raises:
            RenderingError: The camera has lens distortion or is too large, or a pose is not finite.
        """
        colours = np.empty((len(centers), camera.height, camera.width, 3), dtype=np.uint8)
        rotations = np.ascontiguousarray(rotations, dtype=np.float64)
        centers = np.ascontiguousarray(centers, dtype=np.float64)

        def resolve(view: int, band: Band, buffer: Buffer) -> None:
            pose = rotations[view], centers[view]
            resolve_textured(band, buffer, *pose, self._charts, self._background, colours[view])

        samples = camera.scaled(2 * camera.width, 2 * camera.height)
        self._raster.draw_views(samples, rotations, centers, resolve)
        return colours

    def depths(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.float32]:
        """Returns (N, H, W) depths of the mesh, metres; 0 where there is nothing. Arguments as above."""
        return self._raster.depths(camera, rotations, centers)
