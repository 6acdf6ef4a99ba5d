"""Back ends over other libraries: pyrender (OpenGL) and Open3D (extra ``[render]``), and what those need.

Of the system: Debian packages of missing libraries, and a GL driver that answers.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene, build_scene
from lodbench.citymodel.textured_map import TexturedMesh
from lodbench.errors import RenderingError
from lodbench.geometry import Camera, Pose
from lodbench.geometry.angles import blender_from_opencv
from lodbench.kernels import fill_rays, visible_buildings
from lodbench.kernels.arguments import NEAR_M
from lodbench.rendering import projection
from lodbench.rendering.raster import plain_appearance

# Shared library -> Debian and Ubuntu package.
DEBIAN_PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libGLESv2.so.2": "libgles2",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}

# All the packages each back end needs beyond what its wheel brings.
RENDERER_PACKAGES = {
    "pyrender": ("libegl1", "libgl1-mesa-dri", "libgles2"),
    "open3d": ("libgl1", "libgomp1", "libusb-1.0-0", "libx11-6"),
}


def import_fault(renderer: str, error: Exception) -> RenderingError:
    """Returns the fault of a back end that cannot be imported, with what to install as its hint."""
    everything = " ".join(RENDERER_PACKAGES[renderer])
    library = _missing_library(str(error))
    if library is None:
        hint = f"pip install 'lodbench[render]'; Debian: apt-get install {everything}."
        return RenderingError(f"The {renderer} back end cannot be imported ({error}).", hint)
    return RenderingError(
        f"The {renderer} back end needs the system library {library}, which is absent.",
        f"Debian: apt-get install {DEBIAN_PACKAGES.get(library, everything)} (it needs {everything} in all).",
    )


def _missing_library(message: str) -> str | None:
    """Returns the file name of the library that a loader's message complains about."""
    named = re.search(r"lib[\w.+-]+\.so[\w.]*", message)
    if named:
        return named[0]
    # PyOpenGL names what it looked for without its file name.
    return "libEGL.so.1" if "Unable to load EGL library" in message else None


# A first context takes a second or two; a driver that is silent for this long hangs.
_TIMEOUT_S = 60.0
_TRIAL = (sys.executable, "-m", "lodbench.rendering.backends")
_OTHER_WAYS = "See lodbench doctor --thorough; renderer=open3d and renderer=raster need no GL."

_is_tried = threading.Event()


def require_driver(timeout_s: float = _TIMEOUT_S) -> None:
    """Makes sure, once per process, that the GL driver draws and does not hang.

    Raises:
        RenderingError: It cannot be opened, crashes or gives no answer in time.
    """
    if _is_tried.is_set():
        return
    try:
        done = subprocess.run(_TRIAL, capture_output=True, text=True, timeout=timeout_s)  # noqa: S603
    except subprocess.TimeoutExpired:
        raise RenderingError(f"The GL driver gave no answer within {timeout_s:.0f} s.", _OTHER_WAYS) from None
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        raise RenderingError(f"The GL driver crashes ({name}).", _OTHER_WAYS)
    if done.returncode != 0:
        said = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise RenderingError(f"The GL driver cannot draw: {said}", _OTHER_WAYS)
    _is_tried.set()


def trust_driver() -> None:
    """Spares this process the trial, because it is one itself."""
    _is_tried.set()


class Watch:
    """Ends the process, saying why, if what it watches takes too long.

    A driver that hangs cannot be interrupted; all that was finished before is on disk by then.
    """

    def __init__(self, timeout_s: float = _TIMEOUT_S, step_s: float = 1.0) -> None:
        self._timeout_s = timeout_s
        self._step_s = step_s
        self._since: float | None = None
        self._thread: threading.Thread | None = None

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Watches the block."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._look, daemon=True)
            self._thread.start()
        self._since = time.monotonic()
        try:
            yield
        finally:
            self._since = None

    def _look(self) -> None:
        while True:
            time.sleep(self._step_s)
            since = self._since
            if since is not None and time.monotonic() - since > self._timeout_s:
                sys.stderr.write(
                    f"Error: The GL driver has not answered for {self._timeout_s:g} s; giving up.\n"
                    f"{_OTHER_WAYS}\n"
                )
                sys.stderr.flush()
                os._exit(2)


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
        self._spheres = projection.bounding_spheres(scene)
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

        It is of pixel centres, so of one sample per pixel, whatever silhouettes take.
        """
        near, far = self._depth_range(camera, pose)
        if far < _SLICE * near:
            return self._draw(camera, pose, near, far, 1)
        middle = float(np.sqrt(near * far))
        front = self._draw(camera, pose, near, middle, 1)
        return np.where(front > 0, front, self._draw(camera, pose, middle, far, 1))

    def _draw(self, camera: Camera, pose: Pose, near: float, far: float, samples: int) -> NDArray[np.float32]:
        """Returns (H, W) depth of what lies between two distances, metres."""
        projection.require_pinhole(camera)
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
        planes = projection.view_planes(camera, 0, camera.width)
        rotation, center = projection.pose_arrays(pose)
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
        rotations, centers = projection.require_poses(rotations, centers)
        colours = np.empty((len(centers), camera.height, camera.width, 3), dtype=np.uint8)
        background = plain_appearance().background / 255.0
        for i, (rotation, center) in enumerate(zip(rotations, centers, strict=True)):
            colours[i] = self.picture(camera, Pose.from_center(rotation, center), background)
        return colours

    def picture(self, camera: Camera, pose: Pose, background: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Returns the (H, W, 3) RGB picture from a pose before a background, (3,) RGB in [0, 1]."""
        projection.require_pinhole(camera)
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


class Open3dRenderer:
    """Casts a ray through every pixel's centre; a building is where it hits.

    Rays are float32, so edges differ from the raster rule's by a pixel here and there.

    Args:
        scene: The city, local metric frame.
        threads: Worker threads; None for one per core.

    Raises:
        RenderingError: Open3D or a system library it needs is absent.
    """

    name = "open3d"

    def __init__(self, scene: Scene, threads: int | None = None) -> None:
        self.scene = scene
        self._threads = threads or 0
        self._library = _import_open3d()
        tensor = self._library.core.Tensor
        self._caster = self._library.t.geometry.RaycastingScene(nthreads=self._threads)
        self._caster.add_triangles(
            tensor(np.ascontiguousarray(scene.vertices, dtype=np.float32)),
            tensor(np.ascontiguousarray(scene.triangles, dtype=np.uint32)),
        )

    def render(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) silhouette seen from a pose."""
        hits = self._caster.test_occlusions(self._rays(camera, pose), nthreads=self._threads)
        return np.asarray(hits.numpy(), dtype=np.bool_)

    def depth(self, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns (H, W) float32 depth along the optical axis, metres; 0 where there is nothing."""
        t_hit = self._caster.cast_rays(self._rays(camera, pose), nthreads=self._threads)["t_hit"]
        hits = np.asarray(t_hit.numpy(), dtype=np.float32)
        return np.where(np.isfinite(hits), hits + np.float32(NEAR_M), np.float32(0))

    def _rays(self, camera: Camera, pose: Pose) -> Any:
        projection.require_pinhole(camera)
        return self._library.core.Tensor.from_numpy(pixel_rays(camera, pose))


def pixel_rays(camera: Camera, pose: Pose) -> NDArray[np.float32]:
    """Returns (H, W, 6) float32 rays through pixel centres: origin on the near plane, and direction.

    Directions are 1 m long along the optical axis, not in space: so the ray's parameter is depth.
    """
    rays = np.empty((camera.height, camera.width, 6), dtype=np.float32)
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    fill_rays(x, y, *projection.pose_arrays(pose), rays)
    return rays


def _import_open3d() -> Any:
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise import_fault("open3d", error) from error
    return open3d


def main() -> None:
    """Draws a triangle and looks at it.

    Raises:
        RenderingError: It cannot be drawn, or does not show.
    """
    # This is the trial: it must not ask for one.
    trust_driver()
    corners = np.array([[-4.0, -4.0, 5.0], [4.0, -4.0, 5.0], [0.0, 4.0, 5.0]])
    scene = build_scene(corners, np.array([[0, 1, 2]]), np.zeros(1, dtype=np.int32), ("triangle",))
    drawn = PyrenderRenderer(scene).render(Camera(16, 16, 8.0, 8.0, 8.0, 8.0), Pose(np.eye(3), np.zeros(3)))
    if not drawn.any() or drawn.all():
        raise RenderingError("a triangle does not show as one")


if __name__ == "__main__":
    try:
        main()
    except RenderingError as error:
        sys.exit(error.message)
