"""Edges of a scene with the triangles on either side, laid out for the silhouette engine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene


@dataclass(frozen=True, slots=True)
class EdgeTable:
    """Edges grouped by building, each between two triangles of that building, or beside one.

    An edge that more than two triangles share stands here several times; contributions add up.

    Attributes:
        corners: (E, 2) int32 vertex indices, in the direction triangle ``sides[:, 0]`` runs them.
        sides: (E, 2) int32 triangle indices; equal where there is no second triangle.
        second_weight: (E,) int32, +1 if the second triangle runs the edge the same way, -1 if the
            other way (a well-oriented mesh), 0 if there is none.
        starts: (B + 1,) int64 offsets by building.
    """

    corners: NDArray[np.int32]
    sides: NDArray[np.int32]
    second_weight: NDArray[np.int32]
    starts: NDArray[np.int64]


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
