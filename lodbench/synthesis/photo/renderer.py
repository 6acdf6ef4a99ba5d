"""Photos of a city: a z-buffer, shaded pixel by pixel and seen by a camera."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.mesh.textured import TexturedMesh
from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.kernels.arguments import Band, Buffer
from lodbench.kernels.looks import CameraResponse, LandCover, Look, Shading, SunMap
from lodbench.kernels.shading import BRIGHTEST, TONE_STEPS, expose, resolve_photo
from lodbench.photos.pictures import encoded
from lodbench.rendering.raster import RasterRenderer
from lodbench.synthesis.objects.scene_props import SceneProps
from lodbench.synthesis.photo.render_scene import make_render_scene
from lodbench.synthesis.photo.shading import NO_LAND_COVER, PALETTES
from lodbench.synthesis.photo.sunlight import NO_SUN_MAP, draw_sun_map, ground_in_view

# Side of the shadow map, pixels: of the largest one each is half a metre where 450 m are in view.
_LEAST_SUN_MAP, _MOST_SUN_MAP = 512, 1536
# The scenes are of many small triangles.
_BAND = 256


class PhotoRenderer:
    """Renders photos: procedural surfaces, sun with cast shadows, sky, haze, and a camera's faults.

    Deferred: the z-buffer keeps the nearest triangle of two by two samples per pixel, and each triangle in a
    pixel is shaded once. A photo depends on its arguments only, whatever the threads.

    Args:
        scene: The city as the picture shows it, local metric frame.
        props: What stands around it; see ``lodbench.synthesis.objects.scene_props``.
        cover: What covers ground of class ``LAND_COVER``.
        threads: Worker threads; None for one per core.
        textured: A textured mesh of the place to picture instead of the city, in the scene's frame.
            Its textures hold the light of the day they were taken: the sun casts nothing on them.
    """

    def __init__(
        self,
        scene: Scene,
        props: SceneProps | None = None,
        cover: LandCover | None = None,
        threads: int | None = None,
        textured: TexturedMesh | None = None,
    ) -> None:
        self._render_scene = make_render_scene(scene, props, textured)
        self._cover = cover or NO_LAND_COVER
        self._raster = RasterRenderer(self._render_scene.mesh, threads, band=_BAND)
        casters = self._render_scene.casters
        self._casters = None if casters is None else RasterRenderer(casters, threads, band=_BAND)
        low, high = np.percentile(self._render_scene.mesh.vertices[:, 2], [0.5, 99.5])
        self._levels_m = float(low), float(high)

    def photo(self, camera: Camera, pose: Pose, look: Look, response: CameraResponse) -> NDArray[np.uint8]:
        """Returns the (H, W, 3) RGB photo from a pose in the scene's frame.

        Raises:
            RenderingError: The camera has lens distortion or is wider or higher than 4096 pixels.
        """
        return apply_camera_response(self.light(camera, pose, look), response)

    def jpeg(self, camera: Camera, pose: Pose, look: Look, response: CameraResponse) -> bytes:
        """Returns the photo as a JPEG file, of the response's quality."""
        return photo_file(self.photo(camera, pose, look, response), ".jpg", response)

    def light(self, camera: Camera, pose: Pose, look: Look) -> NDArray[np.float32]:
        """Returns (H, W, 3) linear RGB, before the camera."""
        out = np.empty((camera.height, camera.width, 3), dtype=np.float32)
        rotation, center = np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.center)
        sun_map = self._sun_map(camera, pose, look)
        made = self._render_scene
        shading = Shading(made.skin, look, self._cover, sun_map, PALETTES, made.charts)

        def resolve(band: Band, buffer: Buffer) -> None:
            resolve_photo(band, buffer, rotation, center, shading, out)

        self._raster.draw_bands(camera.scaled(2 * camera.width, 2 * camera.height), pose, resolve)
        return out

    def depth(self, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns (H, W) float32 depth of all that is pictured, metres; 0 for the sky."""
        return self._raster.depth(camera, pose)

    def occluders(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) mask of trees, cars and fences that nothing hides."""
        triangle = self._raster.draw(camera, pose).triangle
        return np.asarray((triangle >= 0) & self._render_scene.is_occluder[triangle])

    def _sun_map(self, camera: Camera, pose: Pose, look: Look) -> SunMap:
        if self._casters is None:
            return NO_SUN_MAP
        seen = ground_in_view(camera, pose, *self._levels_m)
        # As fine as the picture, about: in steps, so that its memory is used again.
        size = min(_MOST_SUN_MAP, max(_LEAST_SUN_MAP, (3 * max(camera.width, camera.height) // 2) // 64 * 64))
        return draw_sun_map(self._casters, np.array(look.sun), seen, size)


def photo_file(photo: NDArray[np.uint8], suffix: str, response: CameraResponse) -> bytes:
    """Returns a (H, W, 3) RGB photo as a file: ``.jpg`` of the response's quality, or ``.png``."""
    options = [cv2.IMWRITE_JPEG_QUALITY, response.jpeg_quality] if suffix == ".jpg" else []
    return encoded(np.ascontiguousarray(photo[..., ::-1]), suffix, options)


_MIDDLE = 0.45  # the grey that contrast leaves as it is


def apply_camera_response(light: NDArray[np.float32], how: CameraResponse) -> NDArray[np.uint8]:
    """Returns the (H, W, 3) 8-bit RGB picture of (H, W, 3) linear RGB light, which may be overwritten.

    A light of 1 is white paper in full light.
    """
    import cv2

    if how.blur_px > 0.15:
        blurred = cv2.GaussianBlur(light, (0, 0), how.blur_px, borderType=cv2.BORDER_REPLICATE)
        light = np.asarray(blurred, dtype=np.float32)
    picture = np.empty(light.shape, dtype=np.uint8)
    expose(light, how, _tone_curve(how), picture)
    return picture


def _tone_curve(how: CameraResponse) -> NDArray[np.float32]:
    """Returns the brightness, 0 to 1, of linear light 0, 1 / TONE_STEPS, 2 / TONE_STEPS, ...

    It is the inverse of ``linear``, with a shoulder instead of a hard cut at white, and contrast.
    """
    light = np.arange(TONE_STEPS * BRIGHTEST + 2) / TONE_STEPS
    value = np.sqrt(1.0 - np.exp(-1.55 * light))
    dark = _MIDDLE * (np.minimum(value, _MIDDLE) / _MIDDLE) ** how.contrast
    bright = 1.0 - (1.0 - _MIDDLE) * ((1.0 - np.maximum(value, _MIDDLE)) / (1.0 - _MIDDLE)) ** how.contrast
    return np.where(value < _MIDDLE, dark, bright).astype(np.float32)
