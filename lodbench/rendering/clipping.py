"""Clipping triangles in camera axes against the near plane and the guard band (raster rule 2)."""

from __future__ import annotations

from numba import njit

from lodbench.rendering.raster_rule import GUARD_PX, NEAR_M

# A triangle cut by five planes has at most 3 + 5 corners. Rounding can make a sliver look concave
# to a plane, and each plane can then add half as many corners again: 3, 4, 6, 9, 13, 19.
MAX_CORNERS = 20
NUM_PLANES = 5


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def plane_distance(plane, x, y, z, intrinsics):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
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


@njit(cache=True, nogil=True, error_model="numpy")
def clip_polygon(polygon, count, scratch, intrinsics):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
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
