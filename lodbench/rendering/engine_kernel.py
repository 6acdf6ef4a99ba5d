"""The silhouette engine's hot loop: views of a scene into bit-packed rows, on one core."""

from __future__ import annotations

import numpy as np
from numba import njit

from lodbench.rendering.bits import intersect_and_clear
from lodbench.rendering.clipping import MAX_CORNERS, clip_polygon
from lodbench.rendering.coverage import (
    MAX_LAYERS,
    add_line,
    expect_marks,
    mark_lines,
    sweep,
)
from lodbench.rendering.projection import camera_axes, is_outside, snap
from lodbench.rendering.raster_rule import GUARD_PX, NEAR_M
from lodbench.rendering.selection import select_buildings

# A building whose snapped corners all stay this far inside the guard band needs no clipping.
_SAFE_SUBPIXELS = (GUARD_PX - 2.0) * 256.0


@njit(cache=True, nogil=True, error_model="numpy")
def _project(scene, first, stop, r, c, f, scratch):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Projects vertices to snapped u, v and to depth; those beside the camera, at depth 0, to infinity.

    Kept free of anything but arithmetic, so that the compiler can do several vertices at a time.
    """
    xs, ys, zs, u, v, depth = scene.x, scene.y, scene.z, scratch.u, scratch.v, scratch.depth
    for i in range(np.uint64(stop - first)):
        k = i + np.uint64(first)
        x, y, z = camera_axes(xs[k], ys[k], zs[k], r, c)
        u[i], v[i] = snap(x, y, z, f)
        depth[i] = z


# The flags let the compiler reorder minima, which changes none of them; there is no NaN to find,
# because screen positions are read only when every depth is positive.
@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def _bounds(values, count):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the least and the greatest of the first ``count`` float64 values, count >= 1."""
    low = high = values[0]
    for i in range(np.uint64(count)):
        low, high = min(low, values[i]), max(high, values[i])
    return low, high


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _side(ua, va, ub, vb, uc, vc):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns +1, -1 or 0: which way a snapped triangle turns on the screen."""
    area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
    return np.int32(area > 0.0) - np.int32(area < 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _face(scene, b, scratch):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Writes which way each triangle of a building turns on the screen."""
    u, v, facing = scratch.u, scratch.v, scratch.facing
    first, stop = np.uint64(scene.starts[b, 1]), np.uint64(scene.starts[b + 1, 1])
    for t in range(stop - first):
        i, j, k = scene.corner_a[first + t], scene.corner_b[first + t], scene.corner_c[first + t]
        facing[t] = _side(u[i], v[i], u[j], v[j], u[k], v[k])


@njit(cache=True, nogil=True, error_model="numpy")
def _find_outline(scene, b, scratch):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Writes the weight of each edge of a building, and which are not zero; returns how many."""
    facing, weights, outline = scratch.facing, scratch.weights, scratch.outline
    first, stop = np.uint64(scene.starts[b, 2]), np.uint64(scene.starts[b + 1, 2])
    for e in range(stop - first):
        one, other = facing[scene.side_a[first + e]], facing[scene.side_b[first + e]]
        weights[e] = one + scene.second_weight[first + e] * other
    count = np.uint64(0)
    # Written at every turn and kept by the count: no branch to guess wrong.
    for e in range(stop - first):
        outline[count] = e
        count += np.uint64(weights[e] != 0)
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_building(scene, b, view, scratch):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Marks the edges of a building whose two triangles do not cancel out."""
    u, v, lines = scratch.u, scratch.v, scratch.lines
    _face(scene, b, scratch)
    found = _find_outline(scene, b, scratch)
    first = np.uint64(scene.starts[b, 2])
    count = 0
    for n in range(found):
        e = scratch.outline[n]
        i, j = scene.tail[first + e], scene.head[first + e]
        weight = scratch.weights[e]
        count = add_line(lines, count, view.width, view.height, u[i], v[i], u[j], v[j], weight)
    mark_lines(lines, count, view.height, scratch.coverage.marks)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_clipped(scene, b, rotation, center, view, scratch, words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Draws a building triangle by triangle, clipped: slow, for the few at the edge of the view."""
    f, coverage, lines = view.intrinsics, scratch.coverage, scratch.lines
    polygon, clipped = np.zeros((MAX_CORNERS, 3)), np.zeros((MAX_CORNERS, 3))
    u, v = np.zeros(3), np.zeros(3)
    v0 = scene.starts[b, 0]
    layers = 0
    for t in range(scene.starts[b, 1], scene.starts[b + 1, 1]):
        corners = (scene.corner_a[t], scene.corner_b[t], scene.corner_c[t])
        for i in range(3):
            k = v0 + np.int64(corners[i])
            polygon[i, 0], polygon[i, 1], polygon[i, 2] = camera_axes(
                scene.x[k], scene.y[k], scene.z[k], rotation, center
            )
        kept = clip_polygon(polygon, 3, clipped, f)
        for i in range(1, kept - 1):
            for k, m in enumerate((0, i, i + 1)):
                u[k], v[k] = snap(polygon[m, 0], polygon[m, 1], polygon[m, 2], f)
            side = _side(u[0], v[0], u[1], v[1], u[2], v[2])
            bounds = (u.min(), u.max(), v.min(), v.max())
            if side == 0 or not expect_marks(coverage, *bounds, view.width, view.height):
                continue
            count = 0
            for k in range(3):
                n = k + 1 if k < 2 else 0
                count = add_line(lines, count, view.width, view.height, u[k], v[k], u[n], v[n], side)
            mark_lines(lines, count, view.height, coverage.marks)
            layers += 1
            if layers == MAX_LAYERS:
                sweep(coverage, view.height, words)
                layers = 0
    sweep(coverage, view.height, words)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_view(scene, buildings, rotation, center, view, scratch, words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Draws the silhouette of some buildings into ``words``, which must be clear.

    Args:
        scene: SceneArrays.
        buildings: (N,) indices of the buildings to draw.
        rotation: (3, 3) float64 cam_from_world.
        center: (3,) float64 camera centre, local metres.
        view: View.
        scratch: Scratch.
        words: (H, ceil(W / 64)) uint64.
    """
    u, v, depth, coverage = scratch.u, scratch.v, scratch.depth, scratch.coverage
    layers = 0
    for b in buildings:
        if is_outside(scene.spheres[b], rotation, center, view.planes):
            continue
        v0, v1 = scene.starts[b, 0], scene.starts[b + 1, 0]
        n = v1 - v0
        _project(scene, v0, v1, rotation, center, view.intrinsics, scratch)
        needs_clipping = _bounds(depth, n)[0] < NEAR_M
        if not needs_clipping:
            left, right = _bounds(u, n)
            top, bottom = _bounds(v, n)
            needs_clipping = min(left, top) < -_SAFE_SUBPIXELS or max(right, bottom) > _SAFE_SUBPIXELS
        triangles = scene.starts[b + 1, 1] - scene.starts[b, 1]
        if layers + triangles > MAX_LAYERS or needs_clipping:
            sweep(coverage, view.height, words)
            layers = 0
        if needs_clipping or triangles > MAX_LAYERS:
            _draw_clipped(scene, b, rotation, center, view, scratch, words)
        elif expect_marks(coverage, left, right, top, bottom, view.width, view.height):
            _draw_building(scene, b, view, scratch)
            layers += triangles
    sweep(coverage, view.height, words)


@njit(cache=True, nogil=True, error_model="numpy")
def draw_view(scene, rotation, center, view, scratch, words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Draws the silhouette of a scene into ``words``, (H, ceil(W / 64)) uint64, which must be clear."""
    seen = select_buildings(scene, rotation.reshape(1, 3, 3), center.reshape(1, 3), view.planes)
    _draw_view(scene, seen, rotation, center, view, scratch, words)


@njit(cache=True, nogil=True, error_model="numpy")
def score_views(scene, rotations, centers, view, scratch, words, query, intersections, areas):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Draws N views and counts, for each, the pixels it shares with the query and its own pixels.

    The views should lie close together: they share one selection of buildings.
    """
    chosen = select_buildings(scene, rotations, centers, view.planes)
    for i in range(rotations.shape[0]):
        _draw_view(scene, chosen, rotations[i], centers[i], view, scratch, words)
        intersections[i], areas[i] = intersect_and_clear(words, query)


@njit(cache=True, nogil=True, error_model="numpy")
def draw_views(scene, rotations, centers, view, scratch, words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Draws N views, which should lie close together, into ``words``, (N, H, S), which must be clear."""
    chosen = select_buildings(scene, rotations, centers, view.planes)
    for i in range(rotations.shape[0]):
        _draw_view(scene, chosen, rotations[i], centers[i], view, scratch, words[i])
