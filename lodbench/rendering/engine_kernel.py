"""The silhouette engine's hot loop: views of a scene into bit-packed rows, on one core."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lodbench.rendering.bits import intersect_and_clear
from lodbench.rendering.clipping import MAX_CORNERS, clip_polygon
from lodbench.rendering.coverage import MAX_LAYERS, Coverage, expect_marks, mark_edge, sweep
from lodbench.rendering.raster_rule import GUARD_PX, NEAR_M

# A building whose snapped corners all stay this far inside the guard band needs no clipping.
_SAFE_SUBPIXELS = (GUARD_PX - 2.0) * 256.0

Floats = NDArray[np.float64]
Indices = NDArray[np.int32]


class SceneArrays(NamedTuple):
    """A scene laid out for the kernel; indices count within their building.

    Attributes:
        x: (V,) float32 vertex coordinates, local metres; likewise y and z.
        y: See x.
        z: See x.
        triangles: (T, 3) int32 vertices of each triangle.
        ends: (E, 2) int32 vertices of each edge, in the direction its first triangle runs it.
        sides: (E, 2) int32 triangles on either side of each edge.
        second_weight: (E,) int32, +1, -1 or 0, see ``EdgeTable``.
        starts: (B + 1, 3) int64 offsets of each building's vertices, triangles and edges.
        spheres: (B, 4) float64 bounding spheres (x, y, z, radius).
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    triangles: Indices
    ends: Indices
    sides: Indices
    second_weight: Indices
    starts: NDArray[np.int64]
    spheres: Floats


class View(NamedTuple):
    """A pinhole for the kernel.

    Attributes:
        width: Pixels.
        height: Pixels.
        intrinsics: (4,) float64 fx, fy, cx, cy.
        planes: (5, 3) float64 inward unit normals, through the camera centre, of the space it sees.
    """

    width: int
    height: int
    intrinsics: Floats
    planes: Floats


class Scratch(NamedTuple):
    """Working memory of one thread, for the largest building.

    Attributes:
        u: (V,) float64 snapped columns, sub-pixels.
        v: (V,) float64 snapped rows, sub-pixels.
        depth: (V,) float64 distances along the optical axis, metres.
        facing: (T,) int32, which way each triangle turns on the screen.
        coverage: The view's marks.
    """

    u: Floats
    v: Floats
    depth: Floats
    facing: Indices
    coverage: Coverage


@njit(cache=True, nogil=True)
def _is_outside(sphere, rotation, center, planes):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Tells whether a bounding sphere lies wholly outside one of the view's planes."""
    r = rotation
    dx, dy, dz = sphere[0] - center[0], sphere[1] - center[1], sphere[2] - center[2]
    x = r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz
    y = r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz
    z = r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz
    for i in range(planes.shape[0]):
        if planes[i, 0] * x + planes[i, 1] * y + planes[i, 2] * z < -sphere[3]:
            return True
    return False


@njit(cache=True, nogil=True, inline="always")
def _camera_axes(px, py, pz, r, c):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns a local point in camera axes, metres (raster rule 1)."""
    dx, dy, dz = np.float64(px) - c[0], np.float64(py) - c[1], np.float64(pz) - c[2]
    x = (r[0, 0] * dx + r[0, 1] * dy) + r[0, 2] * dz
    y = (r[1, 0] * dx + r[1, 1] * dy) + r[1, 2] * dz
    z = (r[2, 0] * dx + r[2, 1] * dy) + r[2, 2] * dz
    return x, y, z


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _snap(x, y, z, f):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the snapped screen position of a point in camera axes, sub-pixels (raster rule 3)."""
    inverse = 1.0 / z
    u = (f[0] * x) * inverse + f[2]
    v = (f[1] * y) * inverse + f[3]
    return np.floor(u * 256.0 + 0.5), np.floor(v * 256.0 + 0.5)


@njit(cache=True, nogil=True, error_model="numpy")
def _project(xs, ys, zs, rotation, center, f, u, v, depth):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Projects vertices to snapped u, v and to depth; those beside the camera, at depth 0, to infinity.

    Kept free of anything but arithmetic, so that the compiler can do several vertices at a time.
    """
    for i in range(xs.size):
        x, y, z = _camera_axes(xs[i], ys[i], zs[i], rotation, center)
        u[i], v[i] = _snap(x, y, z, f)
        depth[i] = z


# The flags let the compiler reorder minima, which changes none of them; there is no NaN to find,
# because screen positions are read only when every depth is positive.
@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def _bounds(values):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the least and the greatest of (N,) float64 values, N >= 1."""
    low = high = values[0]
    for i in range(values.size):
        low, high = min(low, values[i]), max(high, values[i])
    return low, high


@njit(cache=True, nogil=True, inline="always")
def _side(ua, va, ub, vb, uc, vc):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns +1, -1 or 0: which way a snapped triangle turns on the screen."""
    area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
    return np.int32(area > 0.0) - np.int32(area < 0.0)


@njit(cache=True, nogil=True)
def _draw_building(scene, b, view, scratch, marks):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Marks the edges of a building whose two triangles do not cancel out."""
    u, v, facing = scratch.u, scratch.v, scratch.facing
    triangles = scene.triangles[scene.starts[b, 1] : scene.starts[b + 1, 1]]
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        facing[t] = _side(u[i], v[i], u[j], v[j], u[k], v[k])
    e0, e1 = scene.starts[b, 2], scene.starts[b + 1, 2]
    ends, sides, second_weight = scene.ends[e0:e1], scene.sides[e0:e1], scene.second_weight[e0:e1]
    for e in range(ends.shape[0]):
        weight = facing[sides[e, 0]] + second_weight[e] * facing[sides[e, 1]]
        if weight != 0:
            i, j = ends[e, 0], ends[e, 1]
            mark_edge(marks, view.width, view.height, u[i], v[i], u[j], v[j], weight)


@njit(cache=True, nogil=True)
def _draw_clipped(scene, b, rotation, center, view, coverage, words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Draws a building triangle by triangle, clipped: slow, for the few at the edge of the view."""
    f = view.intrinsics
    polygon, scratch = np.zeros((MAX_CORNERS, 3)), np.zeros((MAX_CORNERS, 3))
    u, v = np.zeros(3), np.zeros(3)
    v0 = scene.starts[b, 0]
    layers = 0
    for t in range(scene.starts[b, 1], scene.starts[b + 1, 1]):
        for i in range(3):
            k = v0 + scene.triangles[t, i]
            polygon[i, 0], polygon[i, 1], polygon[i, 2] = _camera_axes(
                scene.x[k], scene.y[k], scene.z[k], rotation, center
            )
        count = clip_polygon(polygon, 3, scratch, f)
        for i in range(1, count - 1):
            for k, m in enumerate((0, i, i + 1)):
                u[k], v[k] = _snap(polygon[m, 0], polygon[m, 1], polygon[m, 2], f)
            side = _side(u[0], v[0], u[1], v[1], u[2], v[2])
            bounds = (u.min(), u.max(), v.min(), v.max())
            if side == 0 or not expect_marks(coverage, *bounds, view.width, view.height):
                continue
            for k in range(3):
                n = k + 1 if k < 2 else 0
                mark_edge(coverage.marks, view.width, view.height, u[k], v[k], u[n], v[n], side)
            layers += 1
            if layers == MAX_LAYERS:
                sweep(coverage, view.height, words)
                layers = 0
    sweep(coverage, view.height, words)


@njit(cache=True, nogil=True)
def draw_view(scene, rotation, center, view, scratch, words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Draws the silhouette of a scene into ``words``, which must be clear.

    Args:
        scene: SceneArrays.
        rotation: (3, 3) float64 cam_from_world.
        center: (3,) float64 camera centre, local metres.
        view: View.
        scratch: Scratch.
        words: (H, ceil(W / 64)) uint64.
    """
    u, v, depth, coverage = scratch.u, scratch.v, scratch.depth, scratch.coverage
    layers = 0
    for b in range(scene.spheres.shape[0]):
        if _is_outside(scene.spheres[b], rotation, center, view.planes):
            continue
        v0, v1 = scene.starts[b, 0], scene.starts[b + 1, 0]
        n = v1 - v0
        _project(
            scene.x[v0:v1], scene.y[v0:v1], scene.z[v0:v1], rotation, center, view.intrinsics, u, v, depth
        )
        needs_clipping = _bounds(depth[:n])[0] < NEAR_M
        if not needs_clipping:
            left, right = _bounds(u[:n])
            top, bottom = _bounds(v[:n])
            needs_clipping = min(left, top) < -_SAFE_SUBPIXELS or max(right, bottom) > _SAFE_SUBPIXELS
        triangles = scene.starts[b + 1, 1] - scene.starts[b, 1]
        if layers + triangles > MAX_LAYERS or needs_clipping:
            sweep(coverage, view.height, words)
            layers = 0
        if needs_clipping or triangles > MAX_LAYERS:
            _draw_clipped(scene, b, rotation, center, view, coverage, words)
        elif expect_marks(coverage, left, right, top, bottom, view.width, view.height):
            _draw_building(scene, b, view, scratch, coverage.marks)
            layers += triangles
    sweep(coverage, view.height, words)


@njit(cache=True, nogil=True)
def score_views(scene, rotations, centers, view, scratch, words, query, intersections, areas):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Draws N views and counts, for each, the pixels it shares with the query and its own pixels."""
    for i in range(rotations.shape[0]):
        draw_view(scene, rotations[i], centers[i], view, scratch, words)
        intersections[i], areas[i] = intersect_and_clear(words, query)
