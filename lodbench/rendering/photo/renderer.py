"""Photos of a city on the CPU: the raster's z-buffer, shaded pixel by pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.rendering.photo.develop import develop
from lodbench.rendering.photo.ground import Land, no_land
from lodbench.rendering.photo.kernel import resolve_photo
from lodbench.rendering.photo.look import Development, Look
from lodbench.rendering.photo.stage import make_stage
from lodbench.rendering.photo.sunlight import SunMap, draw_sun_map
from lodbench.rendering.photo.surfaces import palettes
from lodbench.rendering.photo.textured import TexturedMesh
from lodbench.rendering.props import SceneProps
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.raster_kernel import Band, Buffer

# What is in view is found on a picture this wide, pixels: shadows need no more.
_PREVIEW_WIDTH = 96
# Side of the shadow map: with 450 m in view, a pixel is half a metre.
_SUN_MAP_SIZE = 1536


class PhotoRenderer:
    """Renders photos: procedural surfaces, sun with cast shadows, sky, haze, and a camera's faults.

    Deferred: the z-buffer keeps the nearest triangle of two by two samples per pixel, and each
    triangle in a pixel is shaded once. A photo depends on its arguments only, whatever the threads.

    Args:
        scene: The city as the picture shows it, local metric frame.
        props: What stands around it, or None; see ``lodbench.rendering.props``.
        land: What covers ground of class ``LAND``.
        threads: Worker threads; None for one per core.
        textured: A textured mesh of the place to picture instead of the city, in the scene's frame.
            Its textures hold the light of the day they were taken: the sun casts nothing on them.
    """

    def __init__(
        self,
        scene: Scene,
        props: SceneProps | None = None,
        land: Land | None = None,
        threads: int | None = None,
        textured: TexturedMesh | None = None,
    ) -> None:
        self._stage = make_stage(scene, props, textured)
        self._land = land or no_land()
        self._raster = RasterRenderer(self._stage.mesh, threads)
        self._palettes = palettes()

    def photo(self, camera: Camera, pose: Pose, look: Look, development: Development) -> NDArray[np.uint8]:
        """Returns the (H, W, 3) RGB photo from a pose in the scene's frame.

        Raises:
            RenderingError: The camera has lens distortion or is wider or higher than 4096 pixels.
        """
        return develop(self.light(camera, pose, look), development)

    def light(self, camera: Camera, pose: Pose, look: Look) -> NDArray[np.float32]:
        """Returns (H, W, 3) linear RGB, before the camera."""
        out = np.empty((camera.height, camera.width, 3), dtype=np.float32)
        rotation, center = np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.center)
        sun_map = self._sun_map(camera, pose, look)
        stage = (self._stage.skin, look, self._land, sun_map, self._palettes, self._stage.charts)

        def resolve(band: Band, buffer: Buffer) -> None:
            resolve_photo(band, buffer, rotation, center, stage, out)

        self._raster.draw_bands(camera.scaled(2 * camera.width, 2 * camera.height), pose, resolve)
        return out

    def depth(self, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns (H, W) float32 depth of all that is pictured, metres; 0 for the sky."""
        return self._raster.depth(camera, pose)

    def occluders(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) mask of trees, cars and fences that nothing hides."""
        triangle = self._raster.draw(camera, pose).triangle
        return np.asarray((triangle >= 0) & self._stage.is_occluder[triangle])

    def _sun_map(self, camera: Camera, pose: Pose, look: Look) -> SunMap:
        width = min(_PREVIEW_WIDTH, camera.width)
        preview = camera.scaled(width, max(1, round(width * camera.height / camera.width)))
        depth = self._raster.depth(preview, pose).astype(np.float64)
        row, column = np.nonzero(depth > 0)
        z = depth[row, column]
        x = (column + 0.5 - preview.cx) / preview.fx * z
        y = (row + 0.5 - preview.cy) / preview.fy * z
        seen = np.stack([x, y, z], axis=1) @ pose.rotation + pose.center
        if not len(seen):
            seen = pose.center[None]
        return draw_sun_map(self._raster, np.array(look.sun), seen, _SUN_MAP_SIZE)
