"""Pictures of a textured map by the raster: as its textures are, without sun, haze or a camera's faults."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.mesh.textured import TexturedMesh
from lodbench.geometry import Camera
from lodbench.rendering.appearance import plain_appearance
from lodbench.rendering.compiled import per_pixel, pixel_loop
from lodbench.rendering.pixel_samples import same_samples
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.raster_kernel import Band, Buffer
from lodbench.rendering.texture_charts import make_charts, texture_colour
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
            _resolve(band, buffer, *pose, self._charts, self._background, colours[view])

        samples = camera.scaled(2 * camera.width, 2 * camera.height)
        self._raster.draw_views(samples, rotations, centers, resolve)
        return colours

    def depths(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.float32]:
        """Returns (N, H, W) depths of the mesh, metres; 0 where there is nothing. Arguments as above."""
        return self._raster.depths(camera, rotations, centers)


@per_pixel
def _sample(triangle, inverse, column, row, f, rotation, center, charts, background):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the RGB of a triangle, or the background's for -1, at a place of the picture.

    Args:
        triangle: Number, or -1.
        inverse: 1 / depth there.
        column: Place, sample pixels.
        row: Likewise.
        f: (4,) intrinsics, sample pixels.
        rotation: (3, 3) cam_from_world.
        center: (3,) of the camera.
        charts: Charts.
        background: (3,) RGB.
    """
    if triangle < 0:
        return background[0], background[1], background[2]
    depth = 1.0 / inverse
    a, b = depth * (column - f[2]) / f[0], depth * (row - f[3]) / f[1]
    x = center[0] + rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * depth
    y = center[1] + rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * depth
    z = center[2] + rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * depth
    return texture_colour(np.int64(triangle), x, y, z, 2.0 * depth / f[0], charts)


@pixel_loop
def _resolve(band, buffer, rotation, center, charts, background, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Writes a band's pixels, each the mean of two by two samples; a triangle is looked up once in each.

    Args:
        band: Band of the view at twice the picture's size; its first column is even.
        buffer: Its z-buffer.
        rotation: (3, 3) cam_from_world.
        center: (3,) of the camera.
        charts: Charts.
        background: (3,) RGB.
        out: (H, W, 3) uint8.
    """
    for column in range(band.first // 2, band.stop // 2):
        left = 2 * column - band.first
        for row in range(band.height // 2):
            top = 2 * row
            red = green = blue = 0.0
            to_do = 15
            while to_do:
                triangle, to_do, count, inverse, x, y = same_samples(buffer, left, top, to_do)
                colour = _sample(
                    triangle,
                    inverse,
                    x + band.first,
                    y,
                    band.intrinsics,
                    rotation,
                    center,
                    charts,
                    background,
                )
                red += 0.25 * count * colour[0]
                green += 0.25 * count * colour[1]
                blue += 0.25 * count * colour[2]
            out[row, column, 0] = np.uint8(min(max(red + 0.5, 0.0), 255.0))
            out[row, column, 1] = np.uint8(min(max(green + 0.5, 0.0), 255.0))
            out[row, column, 2] = np.uint8(min(max(blue + 0.5, 0.0), 255.0))
