"""Photos of textured meshes through pyrender: the same pictures as the raster's, by OpenGL."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.textured_mesh import TexturedMesh
from lodbench.geometry import Camera, Pose
from lodbench.geometry.angles import blender_from_opencv
from lodbench.rendering.projection import require_pinhole
from lodbench.rendering.pyrender_backend import gl_target, import_pyrender
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
        self._library = import_pyrender()
        self._scene = self._library.Scene(ambient_light=(1.0, 1.0, 1.0))
        for number in range(-1, len(mesh.pictures)):
            chosen = mesh.picture == number
            if chosen.any():
                self._scene.add(self._library.Mesh([self._primitive(mesh, number, chosen)]))
        points = mesh.corners.reshape(-1, 3)
        self._low, self._high = points.min(axis=0), points.max(axis=0)
        self._camera_node: Any = None

    def _primitive(self, mesh: TexturedMesh, number: int, chosen: NDArray[np.bool_]) -> Any:
        positions = mesh.corners[chosen].reshape(-1, 3).astype(np.float32)
        options: dict[str, Any] = {"alphaMode": "OPAQUE", "doubleSided": True}
        if number < 0:
            colours = mesh.colours[chosen].reshape(-1, 3)
            alpha = np.full((len(colours), 1), 255, dtype=np.uint8)
            material = self._library.MetallicRoughnessMaterial(**options)
            return self._library.Primitive(
                positions=positions, color_0=np.hstack([colours, alpha]), mode=4, material=material
            )
        texture = self._library.Texture(source=mesh.pictures[number], source_channels="RGB")
        material = self._library.MetallicRoughnessMaterial(baseColorTexture=texture, **options)
        uv = mesh.uv[chosen].reshape(-1, 2).astype(np.float32)
        return self._library.Primitive(positions=positions, texcoord_0=uv, mode=4, material=material)

    def photo(self, camera: Camera, pose: Pose, look: Look, response: CameraResponse) -> NDArray[np.uint8]:
        """Returns the (H, W, 3) RGB photo from a pose in the mesh's frame.

        Raises:
            RenderingError: The camera has lens distortion or is wider or higher than 8192 pixels.
        """
        require_pinhole(camera)
        if self._camera_node is not None:
            self._scene.remove_node(self._camera_node)
        near, far = self._range(pose)
        lens = self._library.IntrinsicsCamera(camera.fx, camera.fy, camera.cx, camera.cy, near, far)
        self._camera_node = self._scene.add(lens)
        self._scene.set_pose(self._camera_node, blender_from_opencv(pose.world_from_cam))
        self._scene.bg_color = np.sqrt(np.clip([*look.haze_rgb, 1.0], 0.0, 1.0))
        target = gl_target(camera)
        flags = self._library.RenderFlags.FLAT | self._library.RenderFlags.SKIP_CULL_FACES
        picture, _ = target.render(self._scene, flags=flags)
        return apply_camera_response(linear(picture).astype(np.float32), response)

    def _range(self, pose: Pose) -> tuple[float, float]:
        """Returns the distances, metres, between which the mesh lies."""
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        box = self._low + corners * (self._high - self._low)
        depth = (box - pose.center) @ pose.rotation[2]
        outside = np.maximum(np.maximum(self._low - pose.center, pose.center - self._high), 0.0)
        near = max(0.5, 0.5 * float(np.linalg.norm(outside)))
        return near, max(2.0 * near, float(depth.max()))
