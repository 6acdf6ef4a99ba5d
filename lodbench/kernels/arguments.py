"""What kernels of geometry are given: the raster rule, arrays of a scene, a view, working memory.

Named tuples are part of what numba compiles a function for: all that a kernel takes stand in this package, so
that its digest knows them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# The raster rule: what "this pixel is covered" means, to the bit, in engine and reference alike.
#
# 1. A vertex goes to camera axes in float64: ``d = v - center``, then each row of the rotation as
#    ``(r0 * dx + r1 * dy) + r2 * dz``. No matrix product, whose result may depend on the BLAS.
# 2. A triangle with a corner nearer than ``NEAR_M`` or outside the guard band is clipped against
#    the five planes (near, left, right, top, bottom), in that order, and fanned from its first
#    corner. Each remaining piece is a triangle of its own.
# 3. A corner is projected as ``u = (fx * x) * (1 / z) + cx`` and snapped: ``floor(u * 256 + 0.5)``.
# 4. Pixel (column i, row j) has its centre at ``(256 i + 128, 256 j + 128)``. An edge meets column i
#    if one end is at or left of the column's centre and the other right of it (half-open). A pixel
#    is inside a triangle if an odd number of edges meet its column at or above its centre.
# 5. The silhouette is the union of all triangles: front or back, open mesh or closed.

# Sub-pixel steps per pixel, per axis.
SUBPIXELS = 256

# Triangles are cut at this distance in front of the camera, metres.
NEAR_M = 0.1

# Corners further than this from the image origin, in pixels, are clipped away: with it every
# product of two snapped coordinates stays below 2**53 and is exact in float64.
GUARD_PX = 8192.0

# Hypotheses that are drawn side by side; columns of a strip of marks; children of a node of spheres.
LANES, STRIP, BRANCH = 8, 64, 8
# A triangle cut by five planes has at most 3 + 5 corners. Rounding can make a sliver look concave
# to a plane, and each plane can then add half as many corners again: 3, 4, 6, 9, 13, 19.
MAX_CORNERS = 20
# Levels of an edge's strength, equally full over all pixels and directions, and directions over half a turn.
EDGE_LEVELS, DIRECTIONS = 16, 12
# Steps of an edge's strength per mean strength, and the last step.
STRENGTH_STEPS, MAX_STRENGTH = 256.0, 4095

# Steps of tone per unit of linear light, and where light is cut off, units.
TONE_STEPS, MAX_LIGHT = 2048, 4
# The label of a cell that belongs to no plane piece.
UNLABELLED = 0
POWERS_OF_TEN: NDArray[np.float64] = 10.0 ** np.arange(23, dtype=np.float64)  # all exact in float64

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


class Coverage(NamedTuple):
    """Marks of one view, in strips of 64 columns, and where eight hypotheses may have some.

    Hypotheses take turns with the marks: each is swept, and so cleared, before the next.

    Attributes:
        marks: (S * (H + 1) * 64 + 8,) int16, strip by strip, row by row: how much the sum changes at each
            pixel. Row H takes what lies below the view; the last eight are no pixels.
        low: (8, S) int64, first row of each strip that may be marked.
        high: (8, S) int64, last row of each strip that may be marked, -1 for none.
    """

    marks: NDArray[np.int16]
    low: NDArray[np.int64]
    high: NDArray[np.int64]


class EdgeLists(NamedTuple):
    """Outline edges of eight hypotheses, and room to prepare those of one for marking.

    Attributes:
        left: (8 * capacity,) int64, list after list: each edge's left corner and weight, see
            ``pack_corner``.
        right: Likewise its right corner.
        counts: (8,) int64 lengths of the lists.
        weight: (capacity,) int32 what the sum changes by below an edge.
        first_column: (capacity,) int32 first column an edge meets.
        num_columns: (capacity,) int32 how many columns it meets.
        first_row: (capacity,) float64 row at the first column.
        row_step: (capacity,) float64 rows from one column to the next.
    """

    left: NDArray[np.int64]
    right: NDArray[np.int64]
    counts: NDArray[np.int64]
    weight: NDArray[np.int32]
    first_column: NDArray[np.int32]
    num_columns: NDArray[np.int32]
    first_row: NDArray[np.float64]
    row_step: NDArray[np.float64]


class Scratch(NamedTuple):
    """Working memory of one thread, for eight hypotheses of the largest building.

    Attributes:
        poses: (12 * 8,) float64, the nine numbers of cam_from_world and three of the centre, by lane.
        u: (8 V,) int32 snapped columns, sub-pixels.
        v: (8 V,) int32 snapped rows, sub-pixels.
        extent: (4 * 8,) float64 least and greatest column, least and greatest row of a building.
        nearest: (8,) float64 least distance of a building along the optical axis, metres.
        facing: (8 T,) int32, orientation of each triangle on the screen, +1, -1 or 0.
        lists: Outline edges gathered for each hypothesis.
        coverage: The marks of one view.
        candidates: (2, M + 8) int64, the buildings that a group of views may see, see ``select_nearby``.
        polygons: (2, MAX_CORNERS, 3) float64, a triangle that is clipped, and room to do so.
    """

    poses: Floats
    u: NDArray[np.int32]
    v: NDArray[np.int32]
    extent: Floats
    nearest: Floats
    facing: NDArray[np.int32]
    lists: EdgeLists
    coverage: Coverage
    candidates: NDArray[np.int64]
    polygons: Floats


class SphereTree(NamedTuple):
    """Bounding spheres of buildings, of eights of them, of eights of eights, up to one for all.

    Attributes:
        order: (M,) int64 the buildings that are not empty, those close to each other close together.
        nodes: (N, 4) float64 x, y, z, radius: of the buildings in that order, then of each eight nodes
            in turn of the level before, and so on.
        levels: (L + 1,) int64 offsets of the levels into ``nodes``.
    """

    order: NDArray[np.int64]
    nodes: Floats
    levels: NDArray[np.int64]


class Mesh(NamedTuple):
    """A scene for the kernel, see ``Scene``.

    Attributes:
        vertices: (V, 3) float32, local metres.
        triangles: (T, 3) int32.
        vertex_starts: (B + 1,) int64.
        triangle_starts: (B + 1,) int64.
        spheres: (B, 4) float64 bounding spheres.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    vertex_starts: NDArray[np.int64]
    triangle_starts: NDArray[np.int64]
    spheres: Floats


class Band(NamedTuple):
    """Columns of a view.

    Attributes:
        first: First column.
        stop: One past the last.
        height: Rows of the view.
        intrinsics: (4,) float64 fx, fy, cx, cy, pixels.
        planes: (5, 3) float64 what the band sees, see ``view_planes``.
    """

    first: int
    stop: int
    height: int
    intrinsics: Floats
    planes: Floats


class Buffer(NamedTuple):
    """What the columns of a band show; row c of an array is column ``first + c``.

    Attributes:
        inverse: (C, H or more) float64, 1 / metres along the optical axis, 0 where there is nothing.
        triangle: (C, H or more) int32 nearest triangle, -1 where there is nothing.
    """

    inverse: Floats
    triangle: NDArray[np.int32]


class LayerArrays(NamedTuple):
    """The arrays of ``Layers``, for the kernel."""

    depth: NDArray[np.float32]
    building: NDArray[np.int32]
    triangle: NDArray[np.int32]
    normal: NDArray[np.float32]
    colour: NDArray[np.uint8]


class Appearance(NamedTuple):
    """What surfaces look like, for the kernel.

    Attributes:
        walls: (N, 3) uint8 RGB, one of which each building gets by its index.
        roofs: (M, 3) uint8 RGB, likewise, for surfaces that look up.
        background: (3,) uint8 RGB where there is no building.
        sun: (3,) float64 unit vector towards the light, world axes.
        ambient: Share of light that comes from everywhere, 0 to 1.
    """

    walls: NDArray[np.uint8]
    roofs: NDArray[np.uint8]
    background: NDArray[np.uint8]
    sun: NDArray[np.float64]
    ambient: float


class EdgeFaces(NamedTuple):
    """The edges of a scene with the corners opposite to them, for the kernel.

    Attributes:
        corners: (E, 2) int32 vertices that they run between.
        ends: (E, 2, 3) float64 end points, scene metres.
        opposite: (E, 2, 3) float64 third corner of either face; of a boundary edge twice.
        is_boundary: (E,) whether there is one face only.
        is_non_manifold: (E,) whether there are more than two.
        starts: (B + 1,) int64 offsets by building.
    """

    corners: NDArray[np.int32]
    ends: Floats
    opposite: Floats
    is_boundary: NDArray[np.bool_]
    is_non_manifold: NDArray[np.bool_]
    starts: NDArray[np.int64]


class EdgeArrays(NamedTuple):
    """The edges of some buildings, for the kernel.

    Attributes:
        vertices: (V, 3) float64, scene metres.
        corners: (E, 2) int32 vertex indices.
        sides: (E, 2) int32 triangle indices.
        second_weight: (E,) int32, see ``EdgeTable``.
        starts: (B + 1,) int64 edges of each building.
        planes: (T, 4) float64 normal and offset of each triangle.
        spheres: (B, 4) float64 centre and radius.
        base_heights: (B,) float64 lowest height of each building, scene metres.
        heights: (B,) float64 height of each building above its base, metres.
        buildings: (B,) int64 which of the scene's buildings they are.
    """

    vertices: Floats
    corners: NDArray[np.int32]
    sides: NDArray[np.int32]
    second_weight: NDArray[np.int32]
    starts: NDArray[np.int64]
    planes: Floats
    spheres: Floats
    base_heights: Floats
    heights: Floats
    buildings: NDArray[np.int64]


class LinePoses(NamedTuple):
    """N poses, number by number; all arrays (N,).

    Inner loops go along poses, so that several are worked on at a time.

    Attributes:
        rotations: The nine numbers of cam_from_world, row by row.
        centers: The three of the camera's centre, metres.
        map_offsets_m: How much higher than in ``LinePoints`` all roofs and all bases of walls are drawn, and
            how much farther all overhangs reach, metres.
    """

    rotations: tuple[Floats, ...]
    centers: tuple[Floats, ...]
    map_offsets_m: tuple[Floats, ...]


class LinePoints(NamedTuple):
    """P points of lines, for the kernel.

    Attributes:
        points: (P, 2, 3) float64 a point and another farther along its line, scene metres.
        roof_shares: (P, 2) float64 by how much either moves up per metre that roofs are higher.
        base_shares: (P, 2) float64 by how much either moves up per metre that bases of walls are higher.
        overhang_slopes: (P, 2) float64 how far the first moves along x and y per metre of overhang.
        kinds: (P,) int64 its kind, by which levels are scored or counted.
        buildings: (P,) int64 the building that it is summed up or counted for.
    """

    points: Floats
    roof_shares: Floats
    base_shares: Floats
    overhang_slopes: Floats
    kinds: NDArray[np.int64]
    buildings: NDArray[np.int64]
