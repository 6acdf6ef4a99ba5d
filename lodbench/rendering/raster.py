"""The raster: a z-buffer on the CPU that says what is seen where; pictures of textured maps by it.

Those are as the textures are, without sun, haze or a camera's faults.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench import kernels
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.textured_map import TexturedMesh
from lodbench.geometry import Camera, Pose
from lodbench.kernels.arguments import MAX_CORNERS, Appearance, Band, Buffer, LayerArrays, Mesh
from lodbench.kernels.looks import Charts
from lodbench.rendering import projection
from lodbench.rendering.renderer import Layers

_WALLS = [(222, 214, 198), (205, 205, 203), (226, 203, 172), (196, 178, 160), (235, 231, 222)]
_ROOFS = [(166, 92, 70), (140, 84, 72), (120, 122, 126), (150, 150, 148), (96, 88, 86), (182, 120, 88)]


def plain_appearance() -> Appearance:
    """Returns pale walls and red or grey roofs under a sun in the south-west, 50 degrees up."""
    south_west, up = np.cos(np.radians(50.0)) * np.sqrt(0.5), np.sin(np.radians(50.0))
    return Appearance(
        np.array(_WALLS, dtype=np.uint8),
        np.array(_ROOFS, dtype=np.uint8),
        np.array((218, 222, 214), dtype=np.uint8),
        np.array([-south_west, -south_west, up]),
        0.45,
    )


Floats = NDArray[np.float64]

# Columns of a band: narrow enough for its buffer to stay in a core's cache (1024 rows: 0.8 MB), wide
# enough that few buildings are projected for two bands.
_BAND = 64


class RasterRenderer:
    """Renders depth, building and triangle ids, normals and colour, occlusion included.

    Coverage obeys the raster rule to the bit, so ``render`` equals the engine. Depth is where the ray
    through a pixel's centre meets the plane of the triangle, in float64; the nearest triangle wins,
    the first of equals. Each pixel belongs to one band of columns and each band to one thread, so
    the result does not depend on their number. Each thread keeps one band's buffer.

    Args:
        scene: The city, local metric frame.
        threads: Worker threads; None for one per core.
        appearance: Colours and light; None for plain ones.
        band: Columns drawn at a time, even. Many small triangles want wide bands, so that few of them
            are projected for two.
    """

    name = "raster"

    def __init__(
        self,
        scene: Scene,
        threads: int | None = None,
        appearance: Appearance | None = None,
        band: int = _BAND,
    ) -> None:
        self.scene = scene
        self.threads = max(1, threads or os.cpu_count() or 1)
        self._band = band
        self._appearance = appearance or plain_appearance()
        self._mesh = Mesh(
            _read_only(scene.vertices),
            _read_only(scene.triangles),
            _read_only(scene.vertex_starts),
            _read_only(scene.triangle_starts),
            projection.bounding_spheres(scene),
        )
        self._largest = int(np.diff(scene.vertex_starts).max(initial=0))
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self._of_thread = threading.local()

    def draw(self, camera: Camera, pose: Pose) -> Layers:
        """Returns every layer of the view from a pose.

        Raises:
            RenderingError: The camera has lens distortion or is wider or higher than 8192 pixels.
        """
        planes = _blank_planes(camera.width, camera.height)
        center = np.ascontiguousarray(pose.center)

        def resolve(band: Band, buffer: Buffer) -> None:
            kernels.resolve_layers(self._mesh, self._appearance, center, band, buffer, planes)

        self.draw_bands(camera, pose, resolve)
        return Layers(*planes)

    def depth(self, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns (H, W) float32 depth along the optical axis, metres; 0 where there is nothing."""
        rotation, center = projection.pose_arrays(pose)
        return np.asarray(self.depths(camera, rotation[None], center[None])[0])

    def depths(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.float32]:
        """Returns (N, H, W) depths of N views, as ``depth`` gives each.

        Args:
            camera: Pinhole of all views.
            rotations: (N, 3, 3) cam_from_world.
            centers: (N, 3) camera centres, local metres.

        Raises:
            RenderingError: As for ``draw``, or a pose is not finite.
        """
        depths = np.empty((len(centers), camera.height, camera.width), dtype=np.float32)

        def resolve(view: int, band: Band, buffer: Buffer) -> None:
            kernels.resolve_depth(band, buffer, depths[view])

        self.draw_views(camera, rotations, centers, resolve)
        return depths

    def normals(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.float32]:
        """Returns (N, H, W, 3) normals of N views as in ``Layers``; arguments as for ``depths``."""
        normals = np.empty((len(centers), camera.height, camera.width, 3), dtype=np.float32)

        def resolve(view: int, band: Band, buffer: Buffer) -> None:
            kernels.resolve_normals(self._mesh, centers[view], band, buffer, normals[view])

        self.draw_views(camera, rotations, centers, resolve)
        return normals

    def buildings(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.int32]:
        """Returns (N, H, W) buildings seen in N views as in ``Layers``; arguments as for ``depths``."""
        buildings = np.empty((len(centers), camera.height, camera.width), dtype=np.int32)

        def resolve(view: int, band: Band, buffer: Buffer) -> None:
            kernels.resolve_buildings(self._mesh, band, buffer, buildings[view])

        self.draw_views(camera, rotations, centers, resolve)
        return buildings

    def classes(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.uint8]:
        """Returns (N, H, W) classes of surfaces, ``ROOF``, ``WALL`` or 0; arguments as for ``depths``."""
        classes = np.empty((len(centers), camera.height, camera.width), dtype=np.uint8)

        def resolve(view: int, band: Band, buffer: Buffer) -> None:
            classes[view, :, band.first : band.stop] = self._classes.take(buffer.triangle[:, : band.height]).T

        self.draw_views(camera, rotations, centers, resolve)
        return classes

    @cached_property
    def _classes(self) -> NDArray[np.uint8]:
        # The last is that of no triangle, -1, which ``take`` counts from the end.
        return np.append(self.scene.surface_classes(), np.uint8(0))

    def render(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) silhouette seen from a pose."""
        mask = np.empty((camera.height, camera.width), dtype=np.bool_)

        def resolve(band: Band, buffer: Buffer) -> None:
            mask[:, band.first : band.stop] = buffer.triangle[:, : band.height].T >= 0

        self.draw_bands(camera, pose, resolve)
        return mask

    def draw_bands(self, camera: Camera, pose: Pose, resolve: Callable[[Band, Buffer], None]) -> None:
        """Draws a view band by band and hands each to ``resolve``; see ``Band``."""
        rotation, center = projection.pose_arrays(pose)
        self.draw_views(
            camera, rotation[None], center[None], lambda _view, band, buffer: resolve(band, buffer)
        )

    def draw_views(
        self,
        camera: Camera,
        rotations: Floats,
        centers: Floats,
        resolve: Callable[[int, Band, Buffer], None],
    ) -> None:
        """Draws N views, band by band, and hands each band with its view's number to ``resolve``."""
        projection.require_pinhole(camera)
        rotations, centers = projection.require_poses(rotations, centers)
        planes, bands = projection.view_planes(camera, 0, camera.width), tuple(_bands(camera, self._band))

        def work(task: tuple[int, Band, NDArray[np.int64]]) -> None:
            view, band, buildings = task
            buffer = self._blank_buffer(band)
            room = np.empty((self._largest, 5)), np.empty((2, MAX_CORNERS, 3))
            kernels.draw_band(self._mesh, buildings, rotations[view], centers[view], band, buffer, *room)
            resolve(view, band, buffer)

        def tasks() -> Iterator[tuple[int, Band, NDArray[np.int64]]]:
            for view in range(len(centers)):
                visible = kernels.visible_buildings(
                    self._mesh.spheres, rotations[view], centers[view], planes
                )
                yield from ((view, band, visible) for band in bands)

        if self._pool is None:
            for task in tasks():
                work(task)
        else:
            list(self._pool.map(work, tasks()))

    def _blank_buffer(self, band: Band) -> Buffer:
        """Returns this thread's buffer for a band, cleared; it is made when the size of image changes."""
        shape = band.stop - band.first, band.height
        known = getattr(self._of_thread, "buffer", None)
        if known is None or known[0] != shape:
            known = shape, _blank_buffer(*shape)
            self._of_thread.buffer = known
            return known[1]
        buffer: Buffer = known[1]
        buffer.inverse.fill(0.0)
        buffer.triangle.fill(-1)
        return buffer


def _bands(camera: Camera, width: int) -> Iterator[Band]:
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    for first in range(0, camera.width, width):
        stop = min(camera.width, first + width)
        yield Band(first, stop, camera.height, intrinsics, projection.view_planes(camera, first, stop))


def _blank_buffer(columns: int, height: int) -> Buffer:
    """Returns an empty buffer; its columns are an odd number of cache lines long.

    Were it a power of two, as 1024 rows are, all pixels of a row would compete for few places of the cache.
    """
    padded = 16 * ((height + 15) // 16 | 1)
    return Buffer(np.zeros((columns, padded)), np.full((columns, padded), -1, dtype=np.int32))


def _blank_planes(width: int, height: int) -> LayerArrays:
    """Returns room for every layer of a view; the values are yet to be written."""
    return LayerArrays(
        np.empty((height, width), dtype=np.float32),
        np.empty((height, width), dtype=np.int32),
        np.empty((height, width), dtype=np.int32),
        np.empty((height, width, 3), dtype=np.float32),
        np.empty((height, width, 3), dtype=np.uint8),
    )


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Returns an array as scenes from the disk have it: kernels are compiled for one kind of arrays only."""
    view = array.view()
    view.flags.writeable = False
    return view


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
_WIDE_BAND = 256


class TexturedRenderer:
    """Renders a textured mesh: the nearest triangle of two by two samples per pixel, then its texture.

    Args:
        mesh: In the scene's local metric frame.
        threads: Worker threads; None for one per core.
    """

    def __init__(self, mesh: TexturedMesh, threads: int | None = None) -> None:
        order, starts = triangle_groups(mesh.corners)
        self._charts = make_charts(mesh.in_order(order))
        self._raster = RasterRenderer(grouped_scene(mesh.corners[order], starts), threads, band=_WIDE_BAND)
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
            kernels.resolve_textured(band, buffer, *pose, self._charts, self._background, colours[view])

        samples = camera.scaled(2 * camera.width, 2 * camera.height)
        self._raster.draw_views(samples, rotations, centers, resolve)
        return colours

    def depths(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.float32]:
        """Returns (N, H, W) depths of the mesh, metres; 0 where there is nothing. Arguments as above."""
        return self._raster.depths(camera, rotations, centers)
