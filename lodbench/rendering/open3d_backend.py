"""The Open3D back end: ray casting on the CPU, without GL (extra ``[render]``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.rendering.projection import pose_arrays, require_pinhole
from lodbench.rendering.raster_rule import NEAR_M
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
        return np.asarray(np.isfinite(self._cast(camera, pose)))

    def depth(self, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns (H, W) float32 depth along the optical axis, metres; 0 where there is nothing."""
        hits = self._cast(camera, pose)
        return np.where(np.isfinite(hits), hits + np.float32(NEAR_M), np.float32(0))

    def _cast(self, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns (H, W) depths beyond the near plane, metres; infinity where nothing is hit."""
        require_pinhole(camera)
        pose_arrays(pose)
        rays = self._library.core.Tensor(pixel_rays(camera, pose))
        hits = self._caster.cast_rays(rays, nthreads=self._threads)["t_hit"]
        return np.asarray(hits.numpy(), dtype=np.float32)


def pixel_rays(camera: Camera, pose: Pose) -> NDArray[np.float32]:
    """Returns (H, W, 6) float32 rays through pixel centres: origin on the near plane, and direction.

    Directions are 1 m long along the optical axis, not in space: so the ray's parameter is depth.
    """
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    r = pose.rotation
    # The transposed rotation, applied to (x, y, 1).
    along = x[None, :, None] * r[0] + y[:, None, None] * r[1] + r[2]
    return np.concatenate([pose.center + NEAR_M * along, along], axis=2).astype(np.float32)


def _import_open3d() -> Any:
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise import_fault("open3d", error) from error
    return open3d
