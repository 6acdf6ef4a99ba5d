"""The pyrender back end: depth through EGL, a building wherever there is depth (extra ``[render]``)."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.errors import RenderingError
from lodbench.geometry import Camera, Pose
from lodbench.geometry.angles import blender_from_opencv

_NEAR_M, _FAR_M = 1.0, 20_000.0

# The one GL context of the process, once it is open. Contexts share EGL's display, and closing one
# would take the display from under the others.
_open_targets: list[Any] = []


class PyrenderRenderer:
    """Renders silhouettes on OpenGL; the scene is uploaded when first drawn.

    All renderers of a process share one context, so taking turns between scenes uploads anew.

    Raises:
        RenderingError: pyrender or an EGL driver is absent.
    """

    name = "pyrender"

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._library = _import_pyrender()
        mesh = self._library.Mesh(
            [
                self._library.Primitive(
                    positions=scene.vertices.astype(np.float32),
                    indices=scene.triangles,
                    mode=4,
                    material=self._library.MetallicRoughnessMaterial(doubleSided=True),
                )
            ]
        )
        self._gl_scene = self._library.Scene()
        self._gl_scene.add(mesh)
        self._camera_node: Any = None

    def render(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) silhouette seen from a pose."""
        return np.asarray(self.depth(camera, pose) > 0)

    def depth(self, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns (H, W) float32 depth along the optical axis, metres; 0 where there is nothing."""
        target = self._prepare(camera)
        self._gl_scene.set_pose(self._camera_node, blender_from_opencv(pose.world_from_cam))
        flags = self._library.RenderFlags.DEPTH_ONLY | self._library.RenderFlags.SKIP_CULL_FACES
        return np.asarray(target.render(self._gl_scene, flags=flags))

    def _prepare(self, camera: Camera) -> Any:
        """Returns the process's render target, set to the camera's size."""
        if self._camera_node is not None:
            self._gl_scene.remove_node(self._camera_node)
        intrinsics = self._library.IntrinsicsCamera(
            camera.fx, camera.fy, camera.cx, camera.cy, znear=_NEAR_M, zfar=_FAR_M
        )
        self._camera_node = self._gl_scene.add(intrinsics)
        target = _target(self._library, camera)
        target.viewport_width, target.viewport_height = camera.width, camera.height
        return target


def close_context() -> None:
    """Releases the process's GL context, if there is one; a later render opens another."""
    while _open_targets:
        _open_targets.pop().delete()


def _target(library: Any, camera: Camera) -> Any:
    if not _open_targets:
        try:
            _open_targets.append(library.OffscreenRenderer(camera.width, camera.height))
        except Exception as error:  # PyOpenGL raises many kinds when a driver is missing
            raise RenderingError(
                f"pyrender could not open an EGL context ({type(error).__name__}).",
                "On Debian: apt-get install libegl1 libgl1-mesa-dri libgles2.",
            ) from error
    return _open_targets[0]


def _import_pyrender() -> Any:
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    # pyrender 0.1.45 still uses the name that NumPy 2 removed.
    if not hasattr(np, "infty"):
        np.infty = np.inf  # type: ignore[attr-defined]  # noqa: NPY201
    try:
        import pyrender
    except ImportError as error:
        raise RenderingError(
            f"The pyrender back end cannot be imported ({error}).",
            "pip install 'lodbench[render]'; Debian: apt-get install libegl1 libgl1-mesa-dri libgles2.",
        ) from error
    return pyrender
