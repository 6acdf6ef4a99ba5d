"""What the silhouette engine's kernel works on: the scene, the view, and a thread's working memory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.rendering.coverage import Coverage, EdgeLists, blank_coverage, edge_lists
from lodbench.rendering.simd import LANES

Floats = NDArray[np.float64]
Indices = NDArray[np.uint32]


class SceneArrays(NamedTuple):
    """A scene laid out for the kernel; indices count within their building.

    Indices are unsigned: a signed one costs a look at its sign each time it is used.

    Attributes:
        x: (V,) float32 vertex coordinates, local metres; likewise y and z.
        y: See x.
        z: See x.
        corner_a: (T,) uint32 first vertex of each triangle; likewise corner_b and corner_c.
        corner_b: See corner_a.
        corner_c: See corner_a.
        tail: (E,) uint32 vertex each edge starts from, as its first triangle runs it.
        head: (E,) uint32 vertex each edge runs to.
        side_a: (E,) uint32 first triangle beside each edge.
        side_b: (E,) uint32 second triangle beside each edge.
        second_weight: (E,) int32, +1, -1 or 0, see ``EdgeTable``.
        starts: (B + 1, 3) int64 offsets of each building's vertices, triangles and edges.
        spheres: (B, 4) float64 bounding spheres (x, y, z, radius).
        order: (M,) int64, see ``SphereTree``; likewise nodes and levels.
        nodes: (N, 4) float64, see order.
        levels: (L + 1,) int64, see order.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    corner_a: Indices
    corner_b: Indices
    corner_c: Indices
    tail: Indices
    head: Indices
    side_a: Indices
    side_b: Indices
    second_weight: NDArray[np.int32]
    starts: NDArray[np.int64]
    spheres: Floats
    order: NDArray[np.int64]
    nodes: Floats
    levels: NDArray[np.int64]


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
    """Working memory of one thread, for eight hypotheses of the largest building.

    Attributes:
        poses: (12 * 8,) float64, the nine numbers of cam_from_world and three of the centre, by lane.
        u: (8 V,) int32 snapped columns, sub-pixels.
        v: (8 V,) int32 snapped rows, sub-pixels.
        extent: (4 * 8,) float64 least and greatest column, least and greatest row of a building.
        nearest: (8,) float64 least distance of a building along the optical axis, metres.
        facing: (8 T,) int32, which way each triangle turns on the screen.
        lists: Outline edges gathered for each hypothesis.
        coverage: The marks of one view.
    """

    poses: Floats
    u: NDArray[np.int32]
    v: NDArray[np.int32]
    extent: Floats
    nearest: Floats
    facing: NDArray[np.int32]
    lists: EdgeLists
    coverage: Coverage


# Room in a hypothesis's list of edges: more than most views have, and small enough for the cache.
_LIST_CAPACITY = 8192


def blank_scratch(scene: SceneArrays, width: int, height: int) -> Scratch:
    """Returns working memory for a scene and a size of image, pixels."""
    vertices, triangles, edges = (int(n) for n in np.diff(scene.starts, axis=0).max(axis=0, initial=0))
    capacity = max(_LIST_CAPACITY, -(-(edges + 1) // LANES) * LANES)
    return Scratch(
        poses=np.zeros(12 * LANES),
        u=np.zeros(LANES * vertices, dtype=np.int32),
        v=np.zeros(LANES * vertices, dtype=np.int32),
        extent=np.zeros(4 * LANES),
        nearest=np.zeros(LANES),
        facing=np.zeros(LANES * triangles, dtype=np.int32),
        lists=edge_lists(capacity),
        coverage=blank_coverage(width, height),
    )
