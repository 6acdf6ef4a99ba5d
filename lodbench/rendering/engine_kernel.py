"""The silhouette engine's hot loop: views of a scene into bit-packed rows, on one core."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lodbench.rendering.bits import intersect_and_clear
from lodbench.rendering.clipping import MAX_CORNERS, clip_polygon
from lodbench.rendering.contours import EdgeList, add_edge, fill_edges, first_row_at
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
        facing: (T,) int32, which way each triangle turns on the screen.
        edges: The edges of one building.
    """

    u: Floats
    v: Floats
    facing: Indices
    edges: EdgeList


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
def _project(xs, ys, zs, rotation, center, f, u, v):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Projects a building's vertices into u, v; returns its nearest z and its bounds on the screen.

    A vertex beside the camera, at z = 0, has no place on the screen; its infinities are never read,
    for a building nearer than the near plane is drawn clipped.
    """
    nearest = math.inf
    for i in range(xs.size):
        x, y, z = _camera_axes(xs[i], ys[i], zs[i], rotation, center)
        nearest = min(nearest, z)
        u[i], v[i] = _snap(x, y, z, f)
    left = top = math.inf
    right = bottom = -math.inf
    for i in range(xs.size):
        left, right = min(left, u[i]), max(right, u[i])
        top, bottom = min(top, v[i]), max(bottom, v[i])
    return nearest, left, right, top, bottom


@njit(cache=True, nogil=True)
def _face(triangles, u, v, facing):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Writes +1, -1 or 0 for each triangle: which way it turns on the screen."""
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        area = (u[j] - u[i]) * (v[k] - v[i]) - (u[k] - u[i]) * (v[j] - v[i])
        facing[t] = np.int32(area > 0.0) - np.int32(area < 0.0)


@njit(cache=True, nogil=True)
def _add_outline(ends, sides, second_weight, facing, u, v, edges, height):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Adds a building's edges whose two triangles do not cancel out."""
    count = 0
    for e in range(ends.shape[0]):
        weight = facing[sides[e, 0]] + second_weight[e] * facing[sides[e, 1]]
        if weight != 0:
            i, j = ends[e, 0], ends[e, 1]
            count = add_edge(edges, count, height, u[i], v[i], u[j], v[j], weight)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_clipped(scene, b, rotation, center, view, edges, words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Draws a building triangle by triangle, clipped: slow, for the few at the edge of the view."""
    f = view.intrinsics
    polygon, scratch = np.zeros((MAX_CORNERS, 3)), np.zeros((MAX_CORNERS, 3))
    u, v = np.zeros(3), np.zeros(3)
    v0 = scene.starts[b, 0]
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
            number = 0
            for k in range(3):
                n = k + 1 if k < 2 else 0
                number = add_edge(edges, number, view.height, u[k], v[k], u[n], v[n], 1)
            first = max(np.int64(0), first_row_at(min(v[0], v[1], v[2])))
            stop = min(np.int64(view.height), first_row_at(max(v[0], v[1], v[2])))
            fill_edges(edges, first, stop, view.width, words)


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
    u, v, facing, edges = scratch.u, scratch.v, scratch.facing, scratch.edges
    for b in range(scene.spheres.shape[0]):
        if _is_outside(scene.spheres[b], rotation, center, view.planes):
            continue
        v0, t0, e0 = scene.starts[b, 0], scene.starts[b, 1], scene.starts[b, 2]
        v1, t1, e1 = scene.starts[b + 1, 0], scene.starts[b + 1, 1], scene.starts[b + 1, 2]
        nearest, left, right, top, bottom = _project(
            scene.x[v0:v1], scene.y[v0:v1], scene.z[v0:v1], rotation, center, view.intrinsics, u, v
        )
        safe = min(left, top) > -_SAFE_SUBPIXELS and max(right, bottom) < _SAFE_SUBPIXELS
        if nearest < NEAR_M or not safe:
            _draw_clipped(scene, b, rotation, center, view, edges, words)
            continue
        first = max(np.int64(0), first_row_at(top))
        stop = min(np.int64(view.height), first_row_at(bottom))
        if first >= stop or right < 128.0 or left > 256.0 * view.width:
            continue
        _face(scene.triangles[t0:t1], u, v, facing)
        _add_outline(
            scene.ends[e0:e1],
            scene.sides[e0:e1],
            scene.second_weight[e0:e1],
            facing,
            u,
            v,
            edges,
            view.height,
        )
        fill_edges(edges, first, stop, view.width, words)


@njit(cache=True, nogil=True)
def score_views(scene, rotations, centers, view, scratch, words, query, intersections, areas):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Draws N views and counts, for each, the pixels it shares with the query and its own pixels."""
    for i in range(rotations.shape[0]):
        draw_view(scene, rotations[i], centers[i], view, scratch, words)
        intersections[i], areas[i] = intersect_and_clear(words, query)
