"""Pictures of a textured map by the raster: as its textures are, without sun, haze or a camera's faults."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.mesh.textured import TexturedMesh
from lodbench.geometry import Camera
from lodbench.kernels.arguments import Band, Buffer
from lodbench.kernels.textures import resolve_textured
from lodbench.rendering.appearance import plain_appearance
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.texture_charts import make_charts
from lodbench.rendering.triangle_groups import grouped_scene, triangle_groups

Floats = NDArray[np.float64]

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
