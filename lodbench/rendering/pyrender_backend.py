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
from lodbench.kernels.projection import visible_buildings
from lodbench.kernels.raster_rule import NEAR_M
from lodbench.rendering.gl_guard import Watch, require_driver
from lodbench.rendering.projection import pose_arrays, require_pinhole, view_planes
from lodbench.rendering.selection import bounding_spheres
from lodbench.rendering.system_libraries import RENDERER_PACKAGES, import_fault

# The one GL context of the process, once it is open, and its samples per pixel. Contexts share EGL's
# display, and closing one would take the display from under the others.
_open_targets: list[tuple[Any, int]] = []

_watch = Watch()

# What pyrender asks for by itself.
_SAMPLES = 4

# The depth buffer has 24 bits, finest at the near end. A range that ends further out than this many
# times its start is drawn in two slices, or the far end is off by more than 1e-4 of its distance.
_SLICE = 1000.0


class PyrenderRenderer:
    """Renders silhouettes on OpenGL; the scene is uploaded when first drawn.

    All renderers of a process share one context, so taking turns between scenes uploads anew.

    Args:
        scene: The city, local metric frame.
        threads: Not used: the driver has its own.
        samples: Samples per pixel of a silhouette, 4 as pyrender ships; none of them is the pixel's
            centre. With 1 it is, and edges are the raster rule's but for rounding.

    Raises:
        RenderingError: pyrender or an EGL driver is absent; when first drawn, the driver crashes or hangs.
    """

    name = "pyrender"

    def __init__(self, scene: Scene, threads: int | None = None, samples: int = _SAMPLES) -> None:
        self.scene = scene
        self._samples = samples
        self._spheres = bounding_spheres(scene)
        self._library = import_pyrender()
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
        near, far = self._depth_range(camera, pose)
        return np.asarray(self._draw(camera, pose, near, far, self._samples) > 0)

    def depth(self, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns (H, W) float32 depth along the optical axis, metres; 0 where there is nothing.

        It is asked of pixel centres, so of one sample per pixel, whatever silhouettes take.
        """
        near, far = self._depth_range(camera, pose)
        if far < _SLICE * near:
            return self._draw(camera, pose, near, far, 1)
        middle = float(np.sqrt(near * far))
        front = self._draw(camera, pose, near, middle, 1)
        return np.where(front > 0, front, self._draw(camera, pose, middle, far, 1))

    def _draw(self, camera: Camera, pose: Pose, near: float, far: float, samples: int) -> NDArray[np.float32]:
        """Returns (H, W) depth of what lies between two distances, metres."""
        require_pinhole(camera)
        require_driver()
        if self._camera_node is not None:
            self._gl_scene.remove_node(self._camera_node)
        intrinsics = self._library.IntrinsicsCamera(
            camera.fx, camera.fy, camera.cx, camera.cy, znear=near, zfar=far
        )
        self._camera_node = self._gl_scene.add(intrinsics)
        self._gl_scene.set_pose(self._camera_node, blender_from_opencv(pose.world_from_cam))
        with _watch.watching():
            target = _target(self._library, camera, samples)
            target.viewport_width, target.viewport_height = camera.width, camera.height
            return np.asarray(target.render(self._gl_scene, flags=self._library.RenderFlags.DEPTH_ONLY))

    def _depth_range(self, camera: Camera, pose: Pose) -> tuple[float, float]:
        """Returns the distances, metres, between which the buildings in view lie."""
        planes = view_planes(camera, 0, camera.width)
        rotation, center = pose_arrays(pose)
        spheres = self._spheres[visible_buildings(self._spheres, rotation, center, planes)]
        if not len(spheres):
            return NEAR_M, 1.0
        along = (spheres[:, :3] - center) @ rotation[2]
        near = max(NEAR_M, float((along - spheres[:, 3]).min()))
        return near, max(2.0 * near, float((along + spheres[:, 3]).max()))


def close_context() -> None:
    """Releases the process's GL context, if there is one; a later render opens another."""
    while _open_targets:
        _open_targets.pop()[0].delete()


def gl_target(camera: Camera) -> Any:
    """Returns the process's offscreen renderer, sized for a camera, with the samples pyrender ships with."""
    target = _target(import_pyrender(), camera, _SAMPLES)
    target.viewport_width, target.viewport_height = camera.width, camera.height
    return target


def _target(library: Any, camera: Camera, samples: int) -> Any:
    if _open_targets and _open_targets[0][1] != samples:
        close_context()
    if not _open_targets:
        _adjust(samples)
        try:
            _open_targets.append((library.OffscreenRenderer(camera.width, camera.height), samples))
        except Exception as error:  # PyOpenGL raises many kinds when a driver is missing
            raise RenderingError(
                f"pyrender could not open an EGL context ({type(error).__name__}).",
                f"On Debian: apt-get install {' '.join(RENDERER_PACKAGES['pyrender'])}.",
            ) from error
    return _open_targets[0][0]


def _adjust(samples: int) -> None:
    """Gives pyrender's next framebuffer so many samples per pixel, and keeps back faces in depth.

    It has no setting for either: drawing depth alone, it culls whatever its flags say.
    """
    import pyrender.renderer
    from OpenGL import GL

    def allocate(target: int, _samples: int, layout: int, width: int, height: int) -> None:
        # For OpenGL no multisampling is 0 samples.
        GL.glRenderbufferStorageMultisample(target, samples if samples > 1 else 0, layout, width, height)

    def enable(capability: int) -> None:
        if capability != GL.GL_CULL_FACE:
            GL.glEnable(capability)

    pyrender.renderer.glRenderbufferStorageMultisample = allocate
    pyrender.renderer.glEnable = enable


def import_pyrender() -> Any:
    """Returns pyrender, set up for EGL.

    Raises:
        RenderingError: It cannot be imported.
    """
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    # pyrender 0.1.45 still uses the name that NumPy 2 removed.
    if not hasattr(np, "infty"):
        np.infty = np.inf  # type: ignore[attr-defined]  # noqa: NPY201
    try:
        import pyrender
    except ImportError as error:
        raise import_fault("pyrender", error) from error
    return pyrender
