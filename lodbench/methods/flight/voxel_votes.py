"""Which of many places photos show, and what their masks call them."""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def add_votes(places, ground, heights, rotation, center, lens, covered, shown, furthest_m, looks, hits):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Counts where a photo sees places past the map's buildings, and where its mask holds them; in place.

    Args:
        places: (N, 2) east and north, scene metres.
        ground: (N,) heights of the ground there, scene metres.
        heights: (H,) above it at which each is looked for, metres.
        rotation: (3, 3) cam_from_world.
        center: (3,) of the camera.
        lens: Focal lengths and principal point, fx, fy, cx, cy, pixels.
        covered: (rows, columns) what the map explains.
        shown: (rows, columns) the mask.
        furthest_m: Places further off on the ground are left out.
        looks: (H, N) added to where the place is seen.
        hits: (H, N) added to where the mask holds it.
    """
    rows, columns = covered.shape
    for n in range(len(places)):
        east, north = places[n, 0] - center[0], places[n, 1] - center[1]
        if east * east + north * north >= furthest_m * furthest_m:
            continue
        x = rotation[0, 0] * east + rotation[0, 1] * north
        y = rotation[1, 0] * east + rotation[1, 1] * north
        z = rotation[2, 0] * east + rotation[2, 1] * north
        for level in range(len(heights)):
            up = ground[n] + heights[level] - center[2]
            depth = z + rotation[2, 2] * up
            if depth <= 1.0:
                continue
            u = lens[0] * (x + rotation[0, 2] * up) / depth + lens[2]
            v = lens[1] * (y + rotation[1, 2] * up) / depth + lens[3]
            if u < 0.0 or v < 0.0 or u >= columns or v >= rows or covered[int(v), int(u)]:
                continue
            looks[level, n] += 1.0
            if shown[int(v), int(u)]:
                hits[level, n] += 1.0
