"""From world to screen, as the raster rule has it: camera axes, snapping, clipping, what views may see."""

from __future__ import annotations

import numpy as np

from lodbench.kernels.arguments import BRANCH, GUARD_PX, NEAR_M
from lodbench.kernels.compiled import inlined, kernel, part, uncounted


@inlined
def camera_axes(px, py, pz, r, c):
    """Returns a local point in camera axes, metres (raster rule 1)."""
    dx, dy, dz = np.float64(px) - c[0], np.float64(py) - c[1], np.float64(pz) - c[2]
    x = (r[0, 0] * dx + r[0, 1] * dy) + r[0, 2] * dz
    y = (r[1, 0] * dx + r[1, 1] * dy) + r[1, 2] * dz
    z = (r[2, 0] * dx + r[2, 1] * dy) + r[2, 2] * dz
    return x, y, z


@inlined
def snap(x, y, z, f):
    """Returns the snapped screen position of a point in camera axes, sub-pixels (raster rule 3)."""
    inverse = 1.0 / z
    u = (f[0] * x) * inverse + f[2]
    v = (f[1] * y) * inverse + f[3]
    return np.floor(u * 256.0 + 0.5), np.floor(v * 256.0 + 0.5)


@part
def is_outside(sphere, rotation, center, planes):
    """Tells whether a bounding sphere (x, y, z, radius) lies wholly outside one of the planes."""
    x, y, z = camera_axes(sphere[0], sphere[1], sphere[2], rotation, center)
    for i in range(planes.shape[0]):
        if planes[i, 0] * x + planes[i, 1] * y + planes[i, 2] * z < -sphere[3]:
            return True
    return False


@kernel
def visible_buildings(spheres, rotation, center, planes):
    """Returns the indices, ascending, of the buildings whose bounding sphere is not outside."""
    visible = np.empty(spheres.shape[0], dtype=np.int64)
    count = 0
    for b in range(spheres.shape[0]):
        s = spheres[b]
        if not is_outside((s[0], s[1], s[2], s[3]), rotation, center, planes):
            visible[count] = b
            count += 1
    return visible[:count]


NUM_PLANES = 5


@inlined
def plane_distance(plane, x, y, z, intrinsics):
    """Returns a signed distance (any scale) to a plane, inside >= 0; intrinsics are (fx, fy, cx, cy)."""
    if plane == 0:
        return z - NEAR_M
    u = intrinsics[0] * x + intrinsics[2] * z
    v = intrinsics[1] * y + intrinsics[3] * z
    if plane == 1:
        return GUARD_PX * z + u
    if plane == 2:
        return GUARD_PX * z - u
    if plane == 3:
        return GUARD_PX * z + v
    return GUARD_PX * z - v


@part
def clip_polygon(polygon, count, scratch, intrinsics):
    """Clips a convex polygon in place (Sutherland-Hodgman); returns how many corners are left.

    Args:
        polygon: (MAX_CORNERS, 3) float64, camera axes, metres; the first ``count`` rows are used.
        count: Number of corners.
        scratch: (MAX_CORNERS, 3) float64.
        intrinsics: (4,) float64, fx, fy, cx, cy in pixels.
    """
    for plane in range(NUM_PLANES):
        kept = 0
        for i in range(count):
            j = i + 1 if i + 1 < count else 0
            ax, ay, az = polygon[i, 0], polygon[i, 1], polygon[i, 2]
            bx, by, bz = polygon[j, 0], polygon[j, 1], polygon[j, 2]
            da = plane_distance(plane, ax, ay, az, intrinsics)
            db = plane_distance(plane, bx, by, bz, intrinsics)
            if da >= 0.0:
                scratch[kept, 0], scratch[kept, 1], scratch[kept, 2] = ax, ay, az
                kept += 1
            if (da >= 0.0) != (db >= 0.0):
                t = da / (da - db)
                scratch[kept, 0] = ax + t * (bx - ax)
                scratch[kept, 1] = ay + t * (by - ay)
                scratch[kept, 2] = az + t * (bz - az)
                kept += 1
        count = kept
        for i in range(count):
            polygon[i, 0], polygon[i, 1], polygon[i, 2] = scratch[i, 0], scratch[i, 1], scratch[i, 2]
        if count < 3:
            return 0
    return count


@part
def _pose_spread(rotations, centers):
    """Returns how far N views lie from the first, metres, and how much they are turned, as a chord."""
    distance, rotation_chord = 0.0, 0.0
    for i in range(1, rotations.shape[0]):
        square, chord = 0.0, 0.0
        for k in range(3):
            square += (centers[i, k] - centers[0, k]) ** 2
            for m in range(3):
                # The squared Frobenius distance of two rotations is 8 sin(a / 2) ** 2.
                chord += (rotations[i, k, m] - rotations[0, k, m]) ** 2
        distance = max(distance, np.sqrt(square))
        rotation_chord = max(rotation_chord, np.sqrt(chord * 0.5))
    return distance, rotation_chord


@part
def _is_in_any_view(sphere, rotations, centers, planes):
    """Tells whether a sphere is not outside of one of N views at least."""
    for i in range(rotations.shape[0]):
        c = centers[i]
        distance = abs(sphere[0] - c[0]) + abs(sphere[1] - c[1]) + abs(sphere[2] - c[2])
        padded = (sphere[0], sphere[1], sphere[2], sphere[3] + 1e-6 * distance)
        if not is_outside(padded, rotations[i], c, planes):
            return True
    return False


@part
def select_nearby(tree, rotations, centers, planes, candidates):
    """Writes the buildings that any of N nearby views may see into ``seen[0]``; returns how many.

    Seen from the first view, a point at distance s moves by at most ``d + 2 sin(a / 2) (s + d)`` for
    a view at distance d, turned by the angle a: so much is added to each sphere's radius, by what its
    furthest point may move, so a node is never passed over for a child that is not. Views that differ
    by 15 degrees would so take in the city up to the horizon: groups are looked at from each view.

    Args:
        tree: SphereTree, or whatever has its arrays.
        rotations: (N, 3, 3) float64 cam_from_world, N >= 1.
        centers: (N, 3) float64 camera centres, local metres.
        planes: (5, 3) float64, see ``View``.
        candidates: (2, M + BRANCH) int64.
    """
    distance, rotation_chord = _pose_spread(rotations, centers)
    last = tree.levels.shape[0] - 2
    candidates[last & 1 ^ 1, 0] = 0
    count = np.int64(1)
    for level in range(last, -1, -1):
        first, stop = tree.levels[level], tree.levels[level + 1]
        parents, kept, num_parents = candidates[level & 1 ^ 1], candidates[level & 1], count
        count = np.int64(0)
        for i in range(num_parents):
            for node in range(BRANCH * parents[i], min(stop - first, BRANCH * (parents[i] + 1))):
                sphere = tree.nodes[first + node]
                furthest = sphere[3] + np.sqrt(
                    (sphere[0] - centers[0, 0]) ** 2
                    + (sphere[1] - centers[0, 1]) ** 2
                    + (sphere[2] - centers[0, 2]) ** 2
                )
                padding = distance + rotation_chord * (furthest + distance) + 1e-6 * furthest
                padded = (sphere[0], sphere[1], sphere[2], sphere[3] + padding)
                if is_outside(padded, rotations[0], centers[0], planes):
                    continue
                if level > 0 and not _is_in_any_view(sphere, rotations, centers, planes):
                    continue
                kept[count] = node
                count += 1
    for i in range(count):
        candidates[0, i] = tree.order[candidates[0, i]]
    return count


@uncounted
def select_buildings(tree, rotations, centers, planes, candidates):
    """Python's way to ``select_nearby``."""
    return select_nearby(tree, rotations, centers, planes, candidates)
