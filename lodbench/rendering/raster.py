"""The raster: a z-buffer on the CPU that says what is seen where, not only that something is."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.kernels import (
    draw_band,
    resolve_buildings,
    resolve_depth,
    resolve_layers,
    resolve_normals,
    visible_buildings,
)
from lodbench.kernels.arguments import MAX_CORNERS, Appearance, Band, Buffer, LayerArrays, Mesh
from lodbench.rendering.projection import (
    bounding_spheres,
    pose_arrays,
    require_pinhole,
    require_poses,
    view_planes,
)
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
            bounding_spheres(scene),
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
            resolve_layers(self._mesh, self._appearance, center, band, buffer, planes)

        self.draw_bands(camera, pose, resolve)
        return Layers(*planes)

    def depth(self, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns (H, W) float32 depth along the optical axis, metres; 0 where there is nothing."""
        rotation, center = pose_arrays(pose)
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
            resolve_depth(band, buffer, depths[view])

        self.draw_views(camera, rotations, centers, resolve)
        return depths

    def normals(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.float32]:
        """Returns (N, H, W, 3) normals of N views as in ``Layers``; arguments as for ``depths``."""
        normals = np.empty((len(centers), camera.height, camera.width, 3), dtype=np.float32)

        def resolve(view: int, band: Band, buffer: Buffer) -> None:
            resolve_normals(self._mesh, centers[view], band, buffer, normals[view])

        self.draw_views(camera, rotations, centers, resolve)
        return normals

    def buildings(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.int32]:
        """Returns (N, H, W) buildings seen in N views as in ``Layers``; arguments as for ``depths``."""
        buildings = np.empty((len(centers), camera.height, camera.width), dtype=np.int32)

        def resolve(view: int, band: Band, buffer: Buffer) -> None:
            resolve_buildings(self._mesh, band, buffer, buildings[view])

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
        rotation, center = pose_arrays(pose)
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
        require_pinhole(camera)
        rotations, centers = require_poses(rotations, centers)
        planes, bands = view_planes(camera, 0, camera.width), tuple(_bands(camera, self._band))

        def work(task: tuple[int, Band, NDArray[np.int64]]) -> None:
            view, band, buildings = task
            buffer = self._blank_buffer(band)
            room = np.empty((self._largest, 5)), np.empty((2, MAX_CORNERS, 3))
            draw_band(self._mesh, buildings, rotations[view], centers[view], band, buffer, *room)
            resolve(view, band, buffer)

        def tasks() -> Iterator[tuple[int, Band, NDArray[np.int64]]]:
            for view in range(len(centers)):
                seen = visible_buildings(self._mesh.spheres, rotations[view], centers[view], planes)
                yield from ((view, band, seen) for band in bands)

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
        yield Band(first, stop, camera.height, intrinsics, view_planes(camera, first, stop))


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
