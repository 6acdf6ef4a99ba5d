"""The raster: a z-buffer on the CPU that says what is seen where, not only that something is."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.rendering.appearance import Appearance, plain_appearance
from lodbench.rendering.layers import Layers
from lodbench.rendering.projection import pose_arrays, require_pinhole, view_planes, visible_buildings
from lodbench.rendering.raster_kernel import Band, Buffer, Mesh, blank_buffer, draw_band
from lodbench.rendering.raster_layers import blank_planes, resolve_depth, resolve_layers
from lodbench.rendering.selection import bounding_spheres

# Columns of a band: narrow enough for its buffer to stay in a core's cache (1024 rows: 0.8 MB), wide
# enough that few buildings are projected for two bands.
_BAND = 64


class RasterRenderer:
    """Renders depth, building and triangle ids, normals and colour, occlusion included.

    Coverage obeys the raster rule to the bit, so ``render`` equals the engine. Depth is where the ray
    through a pixel's centre meets the plane of the triangle, in float64; the nearest triangle wins,
    the first of equals. Each pixel belongs to one band of columns and each band to one thread, so
    the result does not depend on their number.

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
            scene.vertices,
            scene.triangles,
            scene.vertex_starts,
            scene.triangle_starts,
            bounding_spheres(scene),
        )
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None

    def draw(self, camera: Camera, pose: Pose) -> Layers:
        """Returns every layer of the view from a pose.

        Raises:
            RenderingError: The camera has lens distortion or is wider or higher than 8192 pixels.
        """
        planes = blank_planes(camera.width, camera.height)
        center = np.ascontiguousarray(pose.center)

        def resolve(band: Band, buffer: Buffer) -> None:
            resolve_layers(self._mesh, self._appearance, center, band, buffer, planes)

        self.draw_bands(camera, pose, resolve)
        return Layers(*planes)

    def depth(self, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns (H, W) float32 depth along the optical axis, metres; 0 where there is nothing."""
        depth = np.empty((camera.height, camera.width), dtype=np.float32)
        self.draw_bands(camera, pose, lambda band, buffer: resolve_depth(band, buffer, depth))
        return depth

    def render(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) silhouette seen from a pose."""
        mask = np.empty((camera.height, camera.width), dtype=np.bool_)

        def resolve(band: Band, buffer: Buffer) -> None:
            mask[:, band.first : band.stop] = buffer.winner[:, : band.height].T >= 0

        self.draw_bands(camera, pose, resolve)
        return mask

    def draw_bands(self, camera: Camera, pose: Pose, resolve: Callable[[Band, Buffer], None]) -> None:
        """Draws a view band by band and hands each to ``resolve``; see ``Band``."""
        require_pinhole(camera)
        rotation, center = pose_arrays(pose)
        planes = view_planes(camera, 0, camera.width)
        buildings = visible_buildings(self._mesh.spheres, rotation, center, planes)

        def work(band: Band) -> None:
            buffer = blank_buffer(band.stop - band.first, band.height)
            draw_band(self._mesh, buildings, rotation, center, band, buffer)
            resolve(band, buffer)

        if self._pool is None:
            for band in _bands(camera, self._band):
                work(band)
        else:
            list(self._pool.map(work, _bands(camera, self._band)))


def _bands(camera: Camera, width: int) -> Iterator[Band]:
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    for first in range(0, camera.width, width):
        stop = min(camera.width, first + width)
        yield Band(first, stop, camera.height, intrinsics, view_planes(camera, first, stop))
