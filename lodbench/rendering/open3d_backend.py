"""The Open3D back end: ray casting on the CPU, without GL (extra ``[render]``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.kernels.depth import fill_rays
from lodbench.kernels.raster_rule import NEAR_M
from lodbench.rendering.projection import pose_arrays, require_pinhole
from lodbench.rendering.system_libraries import import_fault


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
        found = self._caster.cast_rays(self._rays(camera, pose), nthreads=self._threads)["t_hit"]
        hits = np.asarray(found.numpy(), dtype=np.float32)
        return np.where(np.isfinite(hits), hits + np.float32(NEAR_M), np.float32(0))

    def _rays(self, camera: Camera, pose: Pose) -> Any:
        require_pinhole(camera)
        return self._library.core.Tensor.from_numpy(pixel_rays(camera, pose))


def pixel_rays(camera: Camera, pose: Pose) -> NDArray[np.float32]:
    """Returns (H, W, 6) float32 rays through pixel centres: origin on the near plane, and direction.

    Directions are 1 m long along the optical axis, not in space: so the ray's parameter is depth.
    """
    rays = np.empty((camera.height, camera.width, 6), dtype=np.float32)
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    fill_rays(x, y, *pose_arrays(pose), rays)
    return rays


def _import_open3d() -> Any:
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise import_fault("open3d", error) from error
    return open3d
