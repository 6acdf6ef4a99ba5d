"""Which buildings a batch of nearby views may see: a tree of bounding spheres over the city.

Buildings are put in order along a Hilbert curve over the plan and bound in eights, the eights in eights
again, and so on: the cost of a selection grows with what is seen, not with the city. A selection can
only be too large, so no picture depends on it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.rendering.projection import is_outside

Floats = NDArray[np.float64]

# Children of a node.
_BRANCH = 8


class SphereTree(NamedTuple):
    """Bounding spheres of buildings, of eights of them, of eights of eights, up to one for all.

    Attributes:
        order: (M,) int64 the buildings that are not empty, those close to each other close together.
        nodes: (N, 4) float64 x, y, z, radius: of the buildings in that order, then of each eight nodes
            in turn of the level before, and so on.
        levels: (L + 1,) int64 offsets of the levels into ``nodes``.
    """

    order: NDArray[np.int64]
    nodes: Floats
    levels: NDArray[np.int64]


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
    starts = np.arange(0, len(spheres), _BRANCH)
    low = np.minimum.reduceat(spheres[:, :3] - spheres[:, 3:], starts, axis=0)
    high = np.maximum.reduceat(spheres[:, :3] + spheres[:, 3:], starts, axis=0)
    middle = (low + high) / 2
    away = np.sqrt(((spheres[:, :3] - np.repeat(middle, _BRANCH, axis=0)[: len(spheres)]) ** 2).sum(axis=1))
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


@njit(cache=True, nogil=True, error_model="numpy")
def _spread_of(rotations, centers):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns how far N views lie from the first, metres, and how much they are turned, as a chord."""
    away, turned = 0.0, 0.0
    for i in range(1, rotations.shape[0]):
        square, chord = 0.0, 0.0
        for k in range(3):
            square += (centers[i, k] - centers[0, k]) ** 2
            for m in range(3):
                # The squared Frobenius distance of two rotations is 8 sin(a / 2) ** 2.
                chord += (rotations[i, k, m] - rotations[0, k, m]) ** 2
        away = max(away, np.sqrt(square))
        turned = max(turned, np.sqrt(chord * 0.5))
    return away, turned


@njit(cache=True, nogil=True, error_model="numpy")
def _any_sees(sphere, rotations, centers, planes):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Tells whether a sphere is not outside of one of N views at least."""
    for i in range(rotations.shape[0]):
        c = centers[i]
        distance = abs(sphere[0] - c[0]) + abs(sphere[1] - c[1]) + abs(sphere[2] - c[2])
        wider = (sphere[0], sphere[1], sphere[2], sphere[3] + 1e-6 * distance)
        if not is_outside(wider, rotations[i], c, planes):
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def select_buildings(tree, rotations, centers, planes):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the buildings, (K,) int64, that any of N nearby views may see.

    Seen from the first view, a point at distance s moves by at most ``d + 2 sin(a / 2) (s + d)`` for
    a view that is d away and turned by the angle a: so much wider is each sphere made, by what its
    furthest point may move, so a node is never passed over for a child that is not. Views that differ
    by 15 degrees would so take in the city up to the horizon: groups are looked at from each view.

    Args:
        tree: SphereTree, or whatever has its arrays.
        rotations: (N, 3, 3) float64 cam_from_world, N >= 1.
        centers: (N, 3) float64 camera centres, local metres.
        planes: (5, 3) float64, see ``View``.
    """
    away, turned = _spread_of(rotations, centers)
    kept = np.zeros(1, dtype=np.int64)
    count = 1
    for level in range(tree.levels.shape[0] - 2, -1, -1):
        first, stop = tree.levels[level], tree.levels[level + 1]
        parents, wanted = kept, count
        kept = np.empty(_BRANCH * wanted, dtype=np.int64)
        count = 0
        for i in range(wanted):
            for node in range(_BRANCH * parents[i], min(stop - first, _BRANCH * (parents[i] + 1))):
                sphere = tree.nodes[first + node]
                furthest = sphere[3] + np.sqrt(
                    (sphere[0] - centers[0, 0]) ** 2
                    + (sphere[1] - centers[0, 1]) ** 2
                    + (sphere[2] - centers[0, 2]) ** 2
                )
                slack = away + turned * (furthest + away) + 1e-6 * furthest
                wider = (sphere[0], sphere[1], sphere[2], sphere[3] + slack)
                if is_outside(wider, rotations[0], centers[0], planes):
                    continue
                if level > 0 and not _any_sees(sphere, rotations, centers, planes):
                    continue
                kept[count] = node
                count += 1
    for i in range(count):
        kept[i] = tree.order[kept[i]]
    return kept[:count]
