"""The edges of a scene, and as a view shows them: creases and contours, visible or hidden."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera
from lodbench.kernels import split_edges
from lodbench.kernels.arguments import EdgeFaces


@dataclass(frozen=True, slots=True)
class EdgeTable:
    """Edges grouped by building, each between two triangles of that building, or beside one.

    An edge that more than two triangles share stands here several times; contributions add up.
    """

    # (E, 2) int32 vertex indices, in the direction triangle ``sides[:, 0]`` runs them
    corners: NDArray[np.int32]
    sides: NDArray[np.int32]  # (E, 2) int32 triangle indices; equal where there is no second triangle
    # (E,) int32, +1 if the second triangle runs the edge the same way, -1 if the other way (a well-
    # oriented mesh), 0 if there is none
    second_weight: NDArray[np.int32]
    starts: NDArray[np.int64]  # (B + 1,) int64 offsets by building


def edge_table(scene: Scene) -> EdgeTable:
    """Returns the edges of a scene; triangles share an edge if they share its two vertex indices."""
    triangles = scene.triangles.astype(np.int64)
    tail = triangles.ravel()
    head = triangles[:, [1, 2, 0]].ravel()
    owner = np.repeat(np.arange(len(triangles)), 3)
    # Vertices belong to one building, so sorting by vertex keys also groups by building.
    key = np.minimum(tail, head) * len(scene.vertices) + np.maximum(tail, head)
    order = np.argsort(key, kind="stable")
    tail, head, owner, key = tail[order], head[order], owner[order], key[order]

    begins = np.ones(len(key), dtype=bool)
    begins[1:] = key[1:] != key[:-1]
    start_of_run = np.maximum.accumulate(np.where(begins, np.arange(len(key)), 0))
    is_first = (np.arange(len(key)) - start_of_run) % 2 == 0
    first = np.flatnonzero(is_first)
    partner = np.minimum(first + 1, len(key) - 1)
    paired = (partner > first) & ~is_first[partner]

    sides = np.stack([owner[first], np.where(paired, owner[partner], owner[first])], axis=1)
    same_way = tail[first] == tail[partner]
    second = np.where(paired, np.where(same_way, 1, -1), 0)
    building = np.searchsorted(scene.vertex_starts, tail[first], side="right") - 1
    return EdgeTable(
        corners=np.stack([tail[first], head[first]], axis=1).astype(np.int32),
        sides=sides.astype(np.int32),
        second_weight=second.astype(np.int32),
        starts=np.searchsorted(building, np.arange(scene.num_buildings + 1)).astype(np.int64),
    )


Floats = NDArray[np.float64]


class EdgePairs(NamedTuple):
    """The edges of a scene by vertices, wherever these are."""

    corners: NDArray[np.int32]  # (E, 2) int32 vertices that they run between
    opposite: NDArray[np.int32]  # (E, 2) int32 third vertex of either face; of a boundary edge twice
    is_boundary: NDArray[np.bool_]  # (E,) whether there is one face only
    is_non_manifold: NDArray[np.bool_]  # (E,) whether there are more than two
    starts: NDArray[np.int64]  # (B + 1,) int64 offsets by building


def edge_pairs(scene: Scene) -> EdgePairs:
    """Returns the edges of a scene; faces meet where they share both vertices, within one building."""
    table = edge_table(scene)
    # An edge of more than two faces stands in the table several times, one after the other.
    pair = np.sort(table.corners, axis=1)
    is_first = np.ones(len(pair), dtype=bool)
    is_first[1:] = (pair[1:] != pair[:-1]).any(axis=1)
    kept = np.flatnonzero(is_first)
    corners, sides = table.corners[kept], table.sides[kept]
    is_non_manifold = np.diff(kept, append=len(pair)) > 1
    is_boundary = (sides[:, 0] == sides[:, 1]) & ~is_non_manifold
    opposite = np.stack([_opposite_corners(scene, corners, side) for side in sides.T], axis=1)
    starts = np.searchsorted(kept, table.starts).astype(np.int64)
    return EdgePairs(corners, opposite, is_boundary, is_non_manifold, starts)


def edge_faces(scene: Scene, pairs: EdgePairs | None = None) -> EdgeFaces:
    """Returns the edges of a scene where its vertices are.

    The pairs are of this scene, or of one that differs in where its vertices are only; None to find them.
    """
    pairs = edge_pairs(scene) if pairs is None else pairs
    points = scene.vertices.astype(np.float64)
    ends, opposite_points = points[pairs.corners], points[pairs.opposite]
    return EdgeFaces(
        pairs.corners, ends, opposite_points, pairs.is_boundary, pairs.is_non_manifold, pairs.starts
    )


def _opposite_corners(scene: Scene, corners: NDArray[np.int32], side: NDArray[np.int32]) -> NDArray[np.int32]:
    triangles = scene.triangles[side]
    is_end = (triangles == corners[:, :1]) | (triangles == corners[:, 1:])
    return np.asarray(triangles[np.arange(len(side)), np.argmin(is_end, axis=1)])


# Pieces of a first try; a view with more is cut again with room for all.
_ROOM = 1 << 14


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
    """Pieces of model edges in one view, each wholly visible or wholly hidden."""

    points: Floats  # (S, 2, 3) float64 end points, scene metres
    pixels: Floats  # (S, 2, 2) float64 the same in the picture, column and row; pixel centres at +0.5
    is_visible: NDArray[np.bool_]  # (S,) whether nothing stands before it, to two pixels at its ends
    kind: NDArray[np.uint8]  # (S,) uint8 ``EdgeKind``
    building: NDArray[np.int64]  # (S,) int64 index into ``scene.building_ids``
    corners: NDArray[np.int32]  # (S, 2) int32 the vertices of the scene between which the whole edge runs
    edge_fractions: Floats  # (S, 2) float64 where on that edge the piece begins and ends, 0 to 1

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

    A place of an edge is hidden if the depth of all 3 x 3 pixels next to it is less than its own, by three
    pixels' footprints and 2 cm; one place is tested per pixel of length. Of an edge that is hidden otherwise,
    up to three pixels in a row that are not count as hidden too.

    Args:
        edges: Of the scene.
        buildings: (K,) indices of the buildings whose edges are wanted.
        camera: Pinhole.
        pose: (3, 3) rotation cam_from_world and (3,) centre.
        depth: (H, W) depth of the view, all buildings in it.
        crease_deg: Least angle between the planes of two faces to be a crease.
    """
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    rotation, center = (np.ascontiguousarray(part) for part in pose)
    view = rotation, center, intrinsics, depth, crease_deg, np.empty(sum(depth.shape) + 2, dtype=np.bool_)
    room, count = _ROOM, _ROOM + 1
    while count > room:
        room = max(room, count)
        edge_fractions, pixels, rows = (
            np.empty((room, 2)),
            np.empty((room, 2, 2)),
            np.empty((room, 4), dtype=np.int64),
        )
        count = split_edges(edges, buildings, *view, edge_fractions, pixels, rows)
    edge_fractions, pixels, rows = edge_fractions[:count], pixels[:count], rows[:count]
    ends = edges.ends[rows[:, 0]]
    points = ends[:, :1] + edge_fractions[:, :, None] * (ends[:, 1:] - ends[:, :1])
    is_visible, kind = rows[:, 1] == 1, rows[:, 2].astype(np.uint8)
    return ViewEdges(points, pixels, is_visible, kind, rows[:, 3], edges.corners[rows[:, 0]], edge_fractions)
