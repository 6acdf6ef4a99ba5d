"""Photos of textured meshes through pyrender: the same pictures as the raster's, by OpenGL."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.textured_mesh import TexturedMesh
from lodbench.geometry import Camera, Pose
from lodbench.rendering.pyrender_textured import PyrenderTextured
from lodbench.synthesis.photo.camera_response import apply_camera_response
from lodbench.synthesis.photo.look import CameraResponse, Look
from lodbench.synthesis.photo.surfaces import linear


class PyrenderPhotos:
    """Renders photos of a textured mesh with OpenGL; no sun and no haze, which textures have already.

    Args:
        mesh: The mesh, local metric frame.

    Raises:
        RenderingError: pyrender or an EGL driver is absent.
    """

    def __init__(self, mesh: TexturedMesh) -> None:
        self._drawn = PyrenderTextured(mesh)

    def photo(self, camera: Camera, pose: Pose, look: Look, response: CameraResponse) -> NDArray[np.uint8]:
        """Returns the (H, W, 3) RGB photo from a pose in the mesh's frame.

        Raises:
            RenderingError: The camera has lens distortion or is wider or higher than 8192 pixels.
        """
        sky = np.sqrt(np.clip(look.haze_rgb, 0.0, 1.0))
        picture = self._drawn.picture(camera, pose, sky)
        return apply_camera_response(linear(picture).astype(np.float32), response)
