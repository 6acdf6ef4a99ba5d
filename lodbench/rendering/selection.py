"""Which buildings a batch of nearby views may see: a tree of bounding spheres over the city.

Buildings are put in order along a Hilbert curve over the plan and bound in eights, the eights in eights
again, and so on: the cost of a selection grows with what is seen, not with the city. A selection can
only be too large, so no picture depends on it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.kernels import projection
from lodbench.kernels.arguments import SceneArrays, SphereTree
from lodbench.kernels.projection import BRANCH

Floats = NDArray[np.float64]


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
    seen = np.zeros((2, len(tree.order) + BRANCH), dtype=np.int64)
    count = projection.select_buildings(tree, rotations, centers, planes, seen)
    return seen[0, :count]
