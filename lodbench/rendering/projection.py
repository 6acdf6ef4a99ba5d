"""From world to screen by the raster rule; which buildings a view may see, and views in order of place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench import kernels
from lodbench.citymodel.scene import Scene
from lodbench.errors import RenderingError
from lodbench.geometry import Camera, Pose
from lodbench.kernels.arguments import BRANCH, GUARD_PX, SceneArrays, SphereTree

Floats = NDArray[np.float64]


def require_pinhole(camera: Camera) -> None:
    """Makes sure that a camera can be rendered.

    Raises:
        RenderingError: The camera has lens distortion or is wider or higher than 8192 pixels.
    """
    if camera.distortion:
        raise RenderingError(
            "A city is rendered with a pinhole; this camera has lens distortion.",
            "Undistort the image and mask first, and give the pinhole's intrinsics.",
        )
    if max(camera.width, camera.height) > GUARD_PX:
        raise RenderingError(f"An image side is longer than {GUARD_PX:.0f} pixels.", "Scale the camera.")


def require_size(camera: Camera, size: tuple[int, int]) -> None:
    """Makes sure that a query of a width and height has the camera's.

    Raises:
        RenderingError: It has not.
    """
    if size != (camera.width, camera.height):
        raise RenderingError(
            f"The query mask is {size[0]} x {size[1]} pixels, the camera {camera.width} x {camera.height}.",
            "Scale the camera with Camera.scaled.",
        )


def require_poses(rotations: Floats, centers: Floats) -> tuple[Floats, Floats]:
    """Returns poses as contiguous float64 arrays, (N, 3, 3) and (N, 3), if they can be drawn.

    Raises:
        RenderingError: A value is not finite, or the shapes are others.
    """
    rotations = np.ascontiguousarray(rotations, dtype=np.float64)
    centers = np.ascontiguousarray(centers, dtype=np.float64)
    if rotations.ndim != 3 or rotations.shape[1:] != (3, 3) or centers.shape != (len(rotations), 3):
        raise RenderingError(
            f"Poses are rotations (N, 3, 3) and centres (N, 3), not {rotations.shape} and {centers.shape}."
        )
    fine = np.isfinite(rotations).all(axis=(1, 2)) & np.isfinite(centers).all(axis=1)
    if not fine.all():
        raise RenderingError(
            f"Pose {int(np.argmin(fine))} of {len(rotations)} has values that are not finite.",
            "Check what made it: an angle or a position is NaN or infinite.",
        )
    return rotations, centers


def pose_arrays(pose: Pose) -> tuple[Floats, Floats]:
    """Returns one pose as contiguous rotation (3, 3) and centre (3,), if it can be drawn.

    Raises:
        RenderingError: A value is not finite.
    """
    rotations, centers = require_poses(pose.rotation[None], pose.center[None])
    return rotations[0], centers[0]


def view_planes(camera: Camera, first: int, stop: int) -> Floats:
    """Returns (5, 3) inward unit normals, through the camera centre, of what columns first to stop see."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    # One pixel wider on every side, so that rounding never culls a covered pixel.
    left, right, top, bottom = first - 1.0, stop + 1.0, -1.0, camera.height + 1.0
    normals = np.array(
        [
            [0.0, 0.0, 1.0],
            [fx, 0.0, cx - left],
            [-fx, 0.0, right - cx],
            [0.0, fy, cy - top],
            [0.0, -fy, bottom - cy],
        ]
    )
    return np.asarray(normals / np.sqrt((normals * normals).sum(axis=1, keepdims=True)))


def sphere_tree(spheres: Floats) -> SphereTree:
    """Returns the tree over (B, 4) spheres, as of ``bounding_spheres``."""
    filled = np.flatnonzero(np.isfinite(spheres[:, 3]))
    order = filled[np.argsort(_hilbert_places(spheres[filled, :2]), kind="stable")]
    levels = [spheres[order]]
    while len(levels[-1]) > 1:
        levels.append(_bound(levels[-1]))
    offsets = np.cumsum([0, *(len(level) for level in levels)])
    return SphereTree(order.astype(np.int64), np.concatenate(levels), offsets.astype(np.int64))


def bounding_spheres(scene: Scene) -> Floats:
    """Returns (B, 4) float64 spheres (x, y, z, radius) round each building; radius -inf if empty."""
    starts = scene.vertex_starts
    filled = np.flatnonzero(np.diff(starts) > 0)
    spheres = np.full((scene.num_buildings, 4), -np.inf)
    low = np.minimum.reduceat(scene.vertices, starts[filled], axis=0).astype(np.float64)
    high = np.maximum.reduceat(scene.vertices, starts[filled], axis=0).astype(np.float64)
    spheres[filled, :3] = (low + high) / 2
    # A millimetre more than the box's half diagonal covers the rounding of the kernel's dot products.
    spheres[filled, 3] = np.sqrt(((high - low) ** 2).sum(axis=1)) / 2 + 1e-3
    return spheres


def _bound(spheres: Floats) -> Floats:
    """Returns (ceil(N / 8), 4) spheres round each eight of (N, 4) spheres in turn."""
    starts = np.arange(0, len(spheres), BRANCH)
    low = np.minimum.reduceat(spheres[:, :3] - spheres[:, 3:], starts, axis=0)
    high = np.maximum.reduceat(spheres[:, :3] + spheres[:, 3:], starts, axis=0)
    middle = (low + high) / 2
    away = np.sqrt(((spheres[:, :3] - np.repeat(middle, BRANCH, axis=0)[: len(spheres)]) ** 2).sum(axis=1))
    reach = np.maximum.reduceat(away + spheres[:, 3], starts)
    return np.concatenate([middle, (reach * (1.0 + 1e-9))[:, None]], axis=1)


def _hilbert_places(points: Floats) -> NDArray[np.int64]:
    """Returns (N,) places along a Hilbert curve of 2**16 x 2**16 cells over (N, 2) points.

    Unlike in Z order, neighbours along the curve are neighbours in the plan, so no node is torn.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    low = points.min(axis=0)
    span = max(float((points.max(axis=0) - low).max()), 1e-9)
    x, y = ((points - low) * ((2**16 - 1) / span)).astype(np.int64).T
    places = np.zeros(len(points), dtype=np.int64)
    for bit in range(15, -1, -1):
        right, up = (x >> bit) & 1, (y >> bit) & 1
        places = (places << 2) | ((3 * right) ^ up)
        # The lower quarters' curves are turned, the right one's backwards.
        backwards = (up == 0) & (right == 1)
        x, y = np.where(backwards, 2**16 - 1 - x, x), np.where(backwards, 2**16 - 1 - y, y)
        x, y = np.where(up == 0, y, x), np.where(up == 0, x, y)
    return places


def select_buildings(
    tree: SphereTree | SceneArrays, rotations: Floats, centers: Floats, planes: Floats
) -> NDArray[np.int64]:
    """Returns the buildings, (K,), that any of N nearby views may see; arguments as of ``select_nearby``."""
    candidates = np.zeros((2, len(tree.order) + BRANCH), dtype=np.int64)
    count = kernels.select_buildings(tree, rotations, centers, planes, candidates)
    return candidates[0, :count]


# A turn by this many metres' worth per radian moves the picture about as a shift does, seen from the
# height drones fly at.
_METRES_PER_RADIAN = 100.0
_BITS = 4


def nearby_order(rotations: Floats, centers: Floats) -> NDArray[np.int64]:
    """Returns an order of N poses along a Z-curve over centres, (N, 3), and directions (Morton 1966)."""
    if len(centers) <= 1:
        return np.arange(len(centers))
    # Neighbours in the first row of the rotation, the camera's x axis, have nearly the same yaw.
    turns = rotations[:, 0, :2] * _METRES_PER_RADIAN
    places = np.concatenate([centers, turns], axis=1)
    low = places.min(axis=0)
    cell = max(float((places.max(axis=0) - low).max()) / 2**_BITS, 1e-9)
    cells = np.minimum((places - low) / cell, 2**_BITS - 1).astype(np.int64)
    key = np.zeros(len(cells), dtype=np.int64)
    for bit in range(_BITS - 1, -1, -1):
        for axis in range(cells.shape[1]):
            key = (key << 1) | ((cells[:, axis] >> bit) & 1)
    return np.argsort(key, kind="stable")
