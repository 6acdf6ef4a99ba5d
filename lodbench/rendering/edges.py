"""The edges of a scene, and as a view shows them: creases and contours, visible or hidden."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera
from lodbench.rendering.projection import camera_axes
from lodbench.rendering.raster_rule import NEAR_M
from lodbench.rendering.topology import edge_table

Floats = NDArray[np.float64]


class EdgePairs(NamedTuple):
    """The edges of a scene by vertices, wherever these are.

    Attributes:
        corners: (E, 2) int32 vertices that they run between.
        thirds: (E, 2) int32 third vertex of either face; of a lone one twice.
        is_lone: (E,) whether there is one face only.
        is_crowded: (E,) whether there are more than two.
        starts: (B + 1,) int64 offsets by building.
    """

    corners: NDArray[np.int32]
    thirds: NDArray[np.int32]
    is_lone: NDArray[np.bool_]
    is_crowded: NDArray[np.bool_]
    starts: NDArray[np.int64]


class EdgeFaces(NamedTuple):
    """The edges of a scene with what lies beside them, for the kernel.

    Attributes:
        corners: (E, 2) int32 vertices that they run between.
        ends: (E, 2, 3) float64 end points, scene metres.
        beside: (E, 2, 3) float64 third corner of either face; of a lone one twice.
        is_lone: (E,) whether there is one face only.
        is_crowded: (E,) whether there are more than two.
        starts: (B + 1,) int64 offsets by building.
    """

    corners: NDArray[np.int32]
    ends: Floats
    beside: Floats
    is_lone: NDArray[np.bool_]
    is_crowded: NDArray[np.bool_]
    starts: NDArray[np.int64]


def edge_pairs(scene: Scene) -> EdgePairs:
    """Returns the edges of a scene; faces meet where they share both vertices, within one building."""
    table = edge_table(scene)
    # An edge of more than two faces stands in the table several times, one after the other.
    pair = np.sort(table.corners, axis=1)
    is_first = np.ones(len(pair), dtype=bool)
    is_first[1:] = (pair[1:] != pair[:-1]).any(axis=1)
    kept = np.flatnonzero(is_first)
    corners, sides = table.corners[kept], table.sides[kept]
    is_crowded = np.diff(kept, append=len(pair)) > 1
    is_lone = (sides[:, 0] == sides[:, 1]) & ~is_crowded
    thirds = np.stack([_third_corners(scene, corners, side) for side in sides.T], axis=1)
    starts = np.searchsorted(kept, table.starts).astype(np.int64)
    return EdgePairs(corners, thirds, is_lone, is_crowded, starts)


def edge_faces(scene: Scene, pairs: EdgePairs | None = None) -> EdgeFaces:
    """Returns the edges of a scene where its vertices are.

    Args:
        scene: The scene.
        pairs: Of this scene, or of one that differs in where its vertices are only; None to find them.
    """
    pairs = edge_pairs(scene) if pairs is None else pairs
    points = scene.vertices.astype(np.float64)
    ends, beside = points[pairs.corners], points[pairs.thirds]
    return EdgeFaces(pairs.corners, ends, beside, pairs.is_lone, pairs.is_crowded, pairs.starts)


def _third_corners(scene: Scene, corners: NDArray[np.int32], side: NDArray[np.int32]) -> NDArray[np.int32]:
    triangles = scene.triangles[side]
    is_end = (triangles == corners[:, :1]) | (triangles == corners[:, 1:])
    return np.asarray(triangles[np.arange(len(side)), np.argmin(is_end, axis=1)])


# Pixels between two places of an edge whose depth is looked at.
_STEP_PX = 1.0
# How much nearer than an edge a surface beside it may be without hiding it: so many pixels' footprints, as
# a surface seen at a slant recedes from pixel to pixel; and metres.
_SLACK_PX, _SLACK_M = 3.0, 0.02
# Steps: as far as the 3 x 3 pixels looked at may see past a rim, at a slant.
_LEAST_RUN = 3
# Faces have planes from this height over their edge on.
_NARROWEST_M = 1e-6


class EdgeKind(IntEnum):
    """Why an edge is one.

    Attributes:
        CREASE: Two faces that are both seen, or both unseen, meet at an angle.
        CONTOUR: One of the faces looks away from the camera, or there is no second face.
    """

    CREASE = 0
    CONTOUR = 1


@dataclass(frozen=True, slots=True, eq=False)
class ViewEdges:
    """Pieces of model edges in one view, each wholly visible or wholly hidden.

    Attributes:
        points: (S, 2, 3) float64 end points, scene metres.
        pixels: (S, 2, 2) float64 the same in the picture, column and row; pixel centres at +0.5.
        is_visible: (S,) whether nothing stands before it, to two pixels at its ends.
        kind: (S,) uint8 ``EdgeKind``.
        building: (S,) int64 index into ``scene.building_ids``.
        corners: (S, 2) int32 the vertices of the scene between which the whole edge runs.
        shares: (S, 2) float64 where on that edge the piece begins and ends, 0 to 1.
    """

    points: Floats
    pixels: Floats
    is_visible: NDArray[np.bool_]
    kind: NDArray[np.uint8]
    building: NDArray[np.int64]
    corners: NDArray[np.int32]
    shares: Floats

    def __len__(self) -> int:
        return len(self.kind)


def edges_in_view(
    edges: EdgeFaces,
    buildings: NDArray[np.int64],
    camera: Camera,
    pose: tuple[Floats, Floats],
    depth: NDArray[np.float32],
    crease_deg: float,
) -> ViewEdges:
    """Returns the edges of some buildings in one view, cut to the picture and split where they are hidden.

    A place of an edge is hidden if the depth of all 3 x 3 pixels around it is less than its own, by
    three pixels' footprints and 2 cm; one place is looked at per pixel of length. Of an edge that is hidden
    otherwise, up to three pixels in a row that are not count as hidden too.

    Args:
        edges: Of the scene.
        buildings: (K,) indices of the buildings to look at.
        camera: Pinhole.
        pose: (3, 3) rotation cam_from_world and (3,) centre.
        depth: (H, W) depth of the view, all buildings in it.
        crease_deg: Least angle between the planes of two faces to be a crease.
    """
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    rotation, center = (np.ascontiguousarray(part) for part in pose)
    shares, pixels, rows, building = _cut_and_test(
        edges, buildings, rotation, center, intrinsics, depth, crease_deg
    )
    ends = edges.ends[rows[:, 0]]
    points = ends[:, :1] + shares[:, :, None] * (ends[:, 1:] - ends[:, :1])
    is_visible, kind = rows[:, 1] == 1, rows[:, 2].astype(np.uint8)
    return ViewEdges(points, pixels, is_visible, kind, building, edges.corners[rows[:, 0]], shares)


@njit(cache=True, nogil=True, error_model="numpy")
def _clipped(a, b, f, width, height):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the shares of an edge, camera axes, between which it is in the picture; first > last: never."""
    first, last = 0.0, 1.0
    for plane in range(5):
        if plane == 0:
            da, db = a[2] - NEAR_M, b[2] - NEAR_M
        elif plane < 3:
            da, db = f[0] * a[0] + f[2] * a[2], f[0] * b[0] + f[2] * b[2]
            if plane == 2:
                da, db = width * a[2] - da, width * b[2] - db
        else:
            da, db = f[1] * a[1] + f[3] * a[2], f[1] * b[1] + f[3] * b[2]
            if plane == 4:
                da, db = height * a[2] - da, height * b[2] - db
        if da < 0.0 and db < 0.0:
            return 1.0, 0.0
        if da < 0.0:
            first = max(first, da / (da - db))
        elif db < 0.0:
            last = min(last, da / (da - db))
    return first, last


@njit(cache=True, nogil=True, error_model="numpy")
def _is_contour(a, b, c, d, is_lone):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Tells whether both faces beside an edge lie on one side of it as seen; camera axes.

    Faces of published models are oriented at random, so their normals are not asked.
    """
    if is_lone:
        return True
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return (x * c[0] + y * c[1] + z * c[2]) * (x * d[0] + y * d[1] + z * d[2]) > 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _is_flat(a, b, c, d, cosine):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Tells whether the planes of the faces beside an edge meet at an angle of a larger cosine; camera axes.

    A face without a height over the edge is no continuation of the other.
    """
    x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    u, v, w = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    r, s, t = d[0] - a[0], d[1] - a[1], d[2] - a[2]
    p0, p1, p2 = y * w - z * v, z * u - x * w, x * v - y * u
    q0, q1, q2 = y * t - z * s, z * r - x * t, x * s - y * r
    # The faces lie on either side of the edge: normals of those that continue each other are opposite.
    size = np.sqrt((p0 * p0 + p1 * p1 + p2 * p2) * (q0 * q0 + q1 * q1 + q2 * q2))
    # Of a face narrower than a micrometre rounding would decide.
    least = _NARROWEST_M**2 * (x * x + y * y + z * z)
    return p0 * q0 + p1 * q1 + p2 * q2 < -cosine * max(size, least)


@njit(cache=True, nogil=True, error_model="numpy")
def _is_seen(u, v, z, focal, depth):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Tells whether nothing hides a place of the picture at a depth: see ``edges_in_view``."""
    least = z - _SLACK_M - _SLACK_PX * z / focal
    row, column = int(np.floor(v)), int(np.floor(u))
    for i in range(row - 1, row + 2):
        for j in range(column - 1, column + 2):
            is_inside = 0 <= i < depth.shape[0] and 0 <= j < depth.shape[1]
            if is_inside and (depth[i, j] == 0.0 or depth[i, j] >= least):
                return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _look_along(line, steps, focal, depth, seen):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Writes for each step along a line of the picture whether it is seen.

    Args:
        line: Column, row and depth where it begins, and where it ends.
        steps: How many.
        focal: Pixels.
        depth: (H, W) metres.
        seen: (steps or more,) bool.
    """
    ua, va, za, ub, vb, zb = line
    for k in range(steps):
        place = (k + 0.5) / steps
        z = 1.0 / ((1.0 - place) / za + place / zb)
        seen[k] = _is_seen(ua + place * (ub - ua), va + place * (vb - va), z, focal, depth)
    # What shows for no longer than the neighbourhood looked at is beside the rim of what hides the rest.
    run = 0
    for k in range(steps + 1):
        if k < steps and seen[k]:
            run += 1
            continue
        if run <= _LEAST_RUN and run < steps:
            seen[k - run : k] = False
        run = 0


@njit(cache=True, nogil=True, error_model="numpy")
def _cut_and_test(edges, buildings, rotation, center, f, depth, crease_deg):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns of each piece: shares of its edge, pixels, (edge, is visible, kind), and its building."""
    shares, pixels = np.empty((256, 2)), np.empty((256, 2, 2))
    rows, owner = np.empty((256, 3), dtype=np.int64), np.empty(256, dtype=np.int64)
    count = 0
    height, width = depth.shape
    flattest = np.cos(np.radians(crease_deg))
    seen = np.empty(int((height + width) / _STEP_PX) + 2, dtype=np.bool_)
    for building in buildings:
        for e in range(edges.starts[building], edges.starts[building + 1]):
            p, q = edges.ends[e, 0], edges.ends[e, 1]
            a = camera_axes(p[0], p[1], p[2], rotation, center)
            b = camera_axes(q[0], q[1], q[2], rotation, center)
            first, last = _clipped(a, b, f, width, height)
            if first >= last:
                continue
            s, t = edges.beside[e, 0], edges.beside[e, 1]
            c = camera_axes(s[0], s[1], s[2], rotation, center)
            d = camera_axes(t[0], t[1], t[2], rotation, center)
            is_contour = _is_contour(a, b, c, d, edges.is_lone[e])
            is_certain = is_contour or edges.is_crowded[e] or crease_deg <= 0.0
            if not is_certain and _is_flat(a, b, c, d, flattest):
                continue
            za, zb = a[2] + first * (b[2] - a[2]), a[2] + last * (b[2] - a[2])
            ua = f[0] * (a[0] + first * (b[0] - a[0])) / za + f[2]
            va = f[1] * (a[1] + first * (b[1] - a[1])) / za + f[3]
            ub = f[0] * (a[0] + last * (b[0] - a[0])) / zb + f[2]
            vb = f[1] * (a[1] + last * (b[1] - a[1])) / zb + f[3]
            line = (ua, va, za, ub, vb, zb)
            steps = max(1, int(np.ceil(np.hypot(ub - ua, vb - va) / _STEP_PX)))
            _look_along(line, steps, min(f[0], f[1]), depth, seen)
            begin = 0
            for k in range(1, steps + 1):
                if k < steps and seen[k] == seen[begin]:
                    continue
                if count == len(owner):
                    shares, pixels = _doubled(shares), _doubled(pixels)
                    rows, owner = _doubled(rows), _doubled(owner)
                for end in range(2):
                    place = (k if end else begin) / steps
                    # Along the line in the picture 1 / z is linear; the share of the edge follows it.
                    z = 1.0 / ((1.0 - place) / za + place / zb)
                    shares[count, end] = first + (last - first) * place * z / zb
                    pixels[count, end, 0] = ua + place * (ub - ua)
                    pixels[count, end, 1] = va + place * (vb - va)
                rows[count, 0], rows[count, 1], rows[count, 2] = e, seen[begin], is_contour
                owner[count] = building
                count += 1
                begin = k
    return shares[:count], pixels[:count], rows[:count], owner[:count]


@njit(cache=True, nogil=True)
def _doubled(values):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns an array of twice as many rows that begins with the given ones."""
    larger = np.empty((2 * values.shape[0], *values.shape[1:]), dtype=values.dtype)
    larger[: values.shape[0]] = values
    return larger
