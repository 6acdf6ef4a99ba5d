"""Pictures of a textured map by OpenGL, through pyrender: the same as the raster's, but for its filters."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.mesh.textured import TexturedMesh
from lodbench.geometry import Camera, Pose
from lodbench.geometry.angles import blender_from_opencv
from lodbench.rendering.appearance import plain_appearance
from lodbench.rendering.gl_guard import require_driver
from lodbench.rendering.projection import require_pinhole, require_poses
from lodbench.rendering.pyrender_backend import gl_target, import_pyrender

Floats = NDArray[np.float64]


class PyrenderTextured:
    """Renders a textured mesh with OpenGL, as its textures are.

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

    def colours(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.uint8]:
        """Returns (N, H, W, 3) RGB pictures of N views; pale where there is nothing.

        Args:
            camera: Pinhole of all views.
            rotations: (N, 3, 3) cam_from_world.
            centers: (N, 3) camera centres, local metres.

        Raises:
            RenderingError: The camera has lens distortion or is wider or higher than 8192 pixels, a pose
                is not finite, or the driver fails.
        """
        rotations, centers = require_poses(rotations, centers)
        colours = np.empty((len(centers), camera.height, camera.width, 3), dtype=np.uint8)
        background = plain_appearance().background / 255.0
        for i, (rotation, center) in enumerate(zip(rotations, centers, strict=True)):
            colours[i] = self.picture(camera, Pose.from_center(rotation, center), background)
        return colours

    def picture(self, camera: Camera, pose: Pose, background: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Returns the (H, W, 3) RGB picture from a pose before a background, (3,) RGB in [0, 1]."""
        require_pinhole(camera)
        require_driver()
        if self._camera_node is not None:
            self._scene.remove_node(self._camera_node)
        near, far = self._range(pose)
        lens = self._library.IntrinsicsCamera(camera.fx, camera.fy, camera.cx, camera.cy, near, far)
        self._camera_node = self._scene.add(lens)
        self._scene.set_pose(self._camera_node, blender_from_opencv(pose.world_from_cam))
        self._scene.bg_color = np.array([*background, 1.0])
        target = gl_target(camera)
        flags = self._library.RenderFlags.FLAT | self._library.RenderFlags.SKIP_CULL_FACES
        return np.asarray(target.render(self._scene, flags=flags)[0], dtype=np.uint8)

    def _range(self, pose: Pose) -> tuple[float, float]:
        """Returns the distances, metres, between which the mesh lies."""
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        box = self._low + corners * (self._high - self._low)
        depth = (box - pose.center) @ pose.rotation[2]
        outside = np.maximum(np.maximum(self._low - pose.center, pose.center - self._high), 0.0)
        near = max(0.5, 0.5 * float(np.linalg.norm(outside)))
        return near, max(2.0 * near, float(depth.max()))
