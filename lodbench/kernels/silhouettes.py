"""The silhouette engine's hot loop: views of a scene into bit-packed rows, on one core.

Eight hypotheses are drawn together: a building is projected, its triangles faced and its outline found
for all eight (``simd_kernels``), each hypothesis gathering the edges of its outlines in a list. Then each
in turn has its edges marked and swept into words, while its marks fit the cache.

Coverage is counted in layers. For every triangle the engine adds the winding number it has on the screen,
turned positive. So the sum at a pixel is the number of layers over it, and the silhouette is where that is
not zero. It is enough to mark, in every column an edge meets, the row where the sum changes; one pass then
adds up each column from the top. Along an edge shared by two triangles that face alike the two marks cancel,
so only the edges of the outline are marked at all. This is exact whatever the mesh: open, closed, or with
faces turned the wrong way; and buildings need not be kept apart.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import Signature
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from lodbench.kernels.arguments import GUARD_PX, LANES, NEAR_M, STRIP
from lodbench.kernels.compiled import kernel, part, uncounted
from lodbench.kernels.masks import intersect_and_clear
from lodbench.kernels.projection import camera_axes, clip_polygon, select_nearby, snap
from lodbench.kernels.simd_kernels import (
    collect_outline,
    face_triangles,
    mark_lines,
    project_vertices,
    set_up_lines,
)

# A sum is read as 16 bits: it is looked at before more triangles than this could add up.
MAX_LAYERS = 30_000


@part
def first_centre_at(position):
    """Returns the first row or column whose centre is at or after a position in sub-pixels."""
    return (np.int64(position) + 127) >> 8


@part
def expect_marks(coverage, lane, left, right, top, bottom, width, height):
    """Notes that marks may follow within bounds in sub-pixels; tells whether the view sees any of them."""
    first_column = max(np.int64(0), first_centre_at(left))
    last_column = min(np.int64(width), first_centre_at(right)) - 1
    first_row = max(np.int64(0), first_centre_at(top))
    last_row = min(np.int64(height), first_centre_at(bottom))
    if first_column > last_column or first_row >= height or last_row < 1:
        return False
    for strip in range(first_column >> 6, (last_column >> 6) + 1):
        coverage.low[lane, strip] = min(coverage.low[lane, strip], first_row)
        coverage.high[lane, strip] = max(coverage.high[lane, strip], last_row)
    return True


@part
def pack_corner(u, v, weight):
    """Returns a snapped corner, each way within 2**23, and a weight in [-128, 127] as one int64.

    From the top: 32 bits row, 8 bits weight, 24 bits column.
    """
    return (np.int64(v) << 32) | ((np.int64(weight) & 0xFF) << 24) | (np.int64(u) & 0xFFFFFF)


@part
def append_edge(lists, lane, width, ua, va, ub, vb, weight):
    """Appends an edge from snapped corner a to b to a hypothesis's list, unless it meets no column."""
    if ua > ub:
        ua, va, ub, vb, weight = ub, vb, ua, va, -weight
    if max(first_centre_at(ua), 0) >= min(first_centre_at(ub), width):
        return
    at = lane * lists.first_column.shape[0] + lists.counts[lane]
    lists.left[at] = pack_corner(ua, va, weight)
    lists.right[at] = pack_corner(ub, vb, weight)
    lists.counts[lane] += 1


@part
def mark_edges(lists, lane, width, height, marks):
    """Marks a hypothesis's edges in every column they meet, and empties its list."""
    start, count = lane * lists.first_column.shape[0], lists.counts[lane]
    prepared = lists.weight, lists.first_column, lists.num_columns, lists.first_row, lists.row_step
    set_up_lines(lists.left, lists.right, start, count, width, *prepared)
    mark_lines(*prepared, count, height, marks, marks.shape[0] - LANES)
    lists.counts[lane] = 0


@intrinsic
def _accumulate_strip(
    _context: Any, marks: Any, start: Any, rows: Any, words: Any, place: Any, stride: Any
) -> tuple[Signature, Any]:
    """Adds up ``rows`` rows of 64 marks each, clears them, and sets a bit per sum that is not zero.

    Written for LLVM directly: it keeps the 64 sums in registers and turns their comparison with zero
    into a bit mask in a few instructions; out of a loop it makes neither.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        marks_data, words_data = (
            make_array(signature.args[i])(context, builder, args[i]).data for i in (0, 3)
        )
        vector = ir.VectorType(ir.IntType(16), STRIP)
        zero = ir.Constant(vector, [0] * STRIP)
        sums = cgutils.alloca_once_value(builder, zero)
        with cgutils.for_range(builder, args[2]) as loop:
            offset = builder.add(args[1], builder.mul(loop.index, ir.Constant(loop.index.type, STRIP)))
            here = builder.bitcast(builder.gep(marks_data, [offset]), vector.as_pointer())
            total = builder.add(builder.load(sums), builder.load(here, align=2))
            builder.store(total, sums)
            builder.store(zero, here, align=2)
            bits = builder.bitcast(builder.icmp_signed("!=", total, zero), ir.IntType(64))
            word = builder.gep(words_data, [builder.add(args[4], builder.mul(loop.index, args[5]))])
            builder.store(builder.or_(builder.load(word), bits), word)
        return context.get_dummy_value()

    return types.void(marks, types.int64, types.int64, words, types.int64, types.int64), generate


@part
def accumulate(coverage, lane, height, words):
    """Sets the bits of ``words``, (H, S) uint64, where a hypothesis's sums are not zero; clears all marks."""
    strips = coverage.low.shape[1]
    for strip in range(strips):
        low, high = coverage.low[lane, strip], coverage.high[lane, strip]
        if high < 0:
            continue
        start = strip * (height + 1) * STRIP
        # The row below the view takes marks but is not looked at.
        rows = min(high, height - 1) + 1 - low
        _accumulate_strip(coverage.marks, start + low * STRIP, rows, words, low * strips + strip, strips)
        coverage.marks[start + height * STRIP : start + (height + 1) * STRIP] = 0
        coverage.low[lane, strip] = height
        coverage.high[lane, strip] = -1


# A building whose snapped corners all stay this far inside the guard band needs no clipping.
_SAFE_SUBPIXELS = int((GUARD_PX - 2.0) * 256.0)


@part
def _orientation(ua, va, ub, vb, uc, vc):
    """Returns a snapped triangle's orientation on the screen, +1, -1 or 0."""
    area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
    return np.int32(area > 0.0) - np.int32(area < 0.0)


@part
def _draw_gathered(view, scratch, words):
    """Draws the edges gathered so far into each hypothesis's words."""
    for lane in range(words.shape[0]):
        mark_edges(scratch.lists, lane, view.width, view.height, scratch.coverage.marks)
        accumulate(scratch.coverage, lane, view.height, words[lane])


@part
def _has_room(lists, edges, hypotheses):
    """Tells whether every hypothesis's list has room for so many edges more, and one."""
    most = np.int64(0)
    for lane in range(hypotheses):
        most = max(most, lists.counts[lane])
    return most + edges < lists.first_column.shape[0]


@part
def _gather_clipped(scene, b, lane, rotation, center, view, scratch, words, layers):
    """Gathers a building's edges triangle by triangle, clipped; returns how many layers there may be now.

    Slow, for the few buildings at the edge of the view, and for those with more triangles than fit.
    """
    f, coverage, lists = view.intrinsics, scratch.coverage, scratch.lists
    polygon, clipped = scratch.polygons[0], scratch.polygons[1]
    first = scene.starts[b, 0]
    for t in range(scene.starts[b, 1], scene.starts[b + 1, 1]):
        corners = (scene.corner_a[t], scene.corner_b[t], scene.corner_c[t])
        for i in range(3):
            k = first + np.int64(corners[i])
            polygon[i, 0], polygon[i, 1], polygon[i, 2] = camera_axes(
                scene.x[k], scene.y[k], scene.z[k], rotation, center
            )
        kept = clip_polygon(polygon, 3, clipped, f)
        for i in range(1, kept - 1):
            u0, v0 = snap(polygon[0, 0], polygon[0, 1], polygon[0, 2], f)
            u1, v1 = snap(polygon[i, 0], polygon[i, 1], polygon[i, 2], f)
            u2, v2 = snap(polygon[i + 1, 0], polygon[i + 1, 1], polygon[i + 1, 2], f)
            orientation = _orientation(u0, v0, u1, v1, u2, v2)
            if orientation == 0:
                continue
            if layers == MAX_LAYERS or not _has_room(lists, np.int64(3), words.shape[0]):
                _draw_gathered(view, scratch, words)
                layers = 0
            left, right = min(u0, min(u1, u2)), max(u0, max(u1, u2))
            top, bottom = min(v0, min(v1, v2)), max(v0, max(v1, v2))
            if not expect_marks(coverage, lane, left, right, top, bottom, view.width, view.height):
                continue
            append_edge(lists, lane, view.width, u0, v0, u1, v1, orientation)
            append_edge(lists, lane, view.width, u1, v1, u2, v2, orientation)
            append_edge(lists, lane, view.width, u2, v2, u0, v0, orientation)
            layers += 1
    return layers


@part
def _classify_views(scene, b, view, scratch, hypotheses):
    """Returns bit masks of the hypotheses that see a projected building whole, and that must clip it."""
    whole, clipped = np.int64(0), np.int64(0)
    is_large = scene.starts[b + 1, 1] - scene.starts[b, 1] > MAX_LAYERS
    extent = scratch.extent
    for lane in range(hypotheses):
        left, right, top, bottom = extent[lane], extent[8 + lane], extent[16 + lane], extent[24 + lane]
        if (
            is_large
            or scratch.nearest[lane] < NEAR_M
            or min(left, top) < -_SAFE_SUBPIXELS
            or max(right, bottom) > _SAFE_SUBPIXELS
        ):
            clipped |= np.int64(1) << lane
        elif expect_marks(scratch.coverage, lane, left, right, top, bottom, view.width, view.height):
            whole |= np.int64(1) << lane
    return whole, clipped


@part
def _gather_whole(scene, b, whole, view, scratch):
    """Gathers a projected building's outline for the hypotheses that see it whole."""
    u, v, lists, capacity = scratch.u, scratch.v, scratch.lists, scratch.lists.first_column.shape[0]
    face_triangles(
        scene.corner_a, scene.corner_b, scene.corner_c, scene.starts[b, 1], scene.starts[b + 1, 1], u, v,
        scratch.facing,
    )  # fmt: skip
    collect_outline(
        scene.tail, scene.head, scene.side_a, scene.side_b, scene.second_weight, scene.starts[b, 2],
        scene.starts[b + 1, 2], scratch.facing, u, v, whole, view.width, view.height, lists.left, lists.right,
        lists.counts, capacity,
    )  # fmt: skip


@part
def draw_group(scene, buildings, count, rotations, centers, view, scratch, words):
    """Draws the silhouettes of some buildings seen from 1 to 8 poses into ``words``, which must be clear.

    Args:
        scene: SceneArrays.
        buildings: (K,) int64 indices of the buildings to draw.
        count: How many of them, from the first on.
        rotations: (N, 3, 3) float64 cam_from_world.
        centers: (N, 3) float64 camera centres, local metres.
        view: View.
        scratch: Scratch.
        words: (N, H, ceil(W / 64)) uint64.
    """
    hypotheses = words.shape[0]
    for lane in range(LANES):
        source = min(lane, hypotheses - 1)
        for i in range(9):
            scratch.poses[8 * i + lane] = rotations[source, i // 3, i % 3]
        for i in range(3):
            scratch.poses[8 * (9 + i) + lane] = centers[source, i]
    layers = 0
    for i in range(count):
        b = buildings[i]
        project_vertices(
            scene.x, scene.y, scene.z, scene.starts[b, 0], scene.starts[b + 1, 0], scratch.poses,
            view.intrinsics, scratch.u, scratch.v, scratch.extent, scratch.nearest,
        )  # fmt: skip
        triangles, edges = (
            scene.starts[b + 1, 1] - scene.starts[b, 1],
            scene.starts[b + 1, 2] - scene.starts[b, 2],
        )
        if layers + triangles > MAX_LAYERS or not _has_room(scratch.lists, edges, hypotheses):
            _draw_gathered(view, scratch, words)
            layers = 0
        whole, clipped = _classify_views(scene, b, view, scratch, hypotheses)
        if whole != 0:
            _gather_whole(scene, b, whole, view, scratch)
            layers += triangles
        for lane in range(hypotheses):
            if (clipped >> lane) & 1:
                layers = _gather_clipped(
                    scene, b, lane, rotations[lane], centers[lane], view, scratch, words, layers
                )
    _draw_gathered(view, scratch, words)


@uncounted
def draw_views(scene, rotations, centers, view, scratch, words):
    """Draws N views into ``words``, (N, H, S), which must be clear; see ``score_views``."""
    for i in range(0, rotations.shape[0], LANES):
        r, c = rotations[i : i + LANES], centers[i : i + LANES]
        count = select_nearby(scene, r, c, view.planes, scratch.candidates)
        draw_group(scene, scratch.candidates[0], count, r, c, view, scratch, words[i : i + LANES])


@uncounted
def score_views(scene, rotations, centers, view, scratch, words, query, counts):
    """Draws N views; writes to ``counts``, (2, N) int64, the pixels each shares with the query, and its own.

    Each eight views in turn should lie close together: they share a selection of buildings. ``words``,
    (8, H, S), must be clear, and is again afterwards.
    """
    for i in range(0, rotations.shape[0], LANES):
        r, c = rotations[i : i + LANES], centers[i : i + LANES]
        count = select_nearby(scene, r, c, view.planes, scratch.candidates)
        draw_group(scene, scratch.candidates[0], count, r, c, view, scratch, words[: r.shape[0]])
        for lane in range(r.shape[0]):
            counts[0, i + lane], counts[1, i + lane] = intersect_and_clear(words[lane], query)


@part
def _pixel_range(middle, half, near, far, focal, offset, size):
    """Returns the first pixel and the last + 1 that a span between two depths may cover."""
    low = focal * min((middle - half) / near, (middle - half) / far) + offset - 1.0
    high = focal * max((middle + half) / near, (middle + half) / far) + offset + 2.0
    limit = np.float64(size)
    return np.int64(min(max(low, 0.0), limit)), np.int64(min(max(high, 0.0), limit))


@part
def _bounding_box(sphere, rotation, center, view):
    """Returns rows and words (first row, last + 1, first word, last + 1) that a sphere may cover."""
    x, y, z = camera_axes(sphere[0], sphere[1], sphere[2], rotation, center)
    radius = sphere[3] + 1e-6 * (abs(x) + abs(y) + abs(z))
    left, right, top, bottom = np.int64(0), np.int64(view.width), np.int64(0), np.int64(view.height)
    if z - radius > NEAR_M:
        f, near, far = view.intrinsics, z - radius, z + radius
        left, right = _pixel_range(x, radius, near, far, f[0], f[2], view.width)
        top, bottom = _pixel_range(y, radius, near, far, f[1], f[3], view.height)
    return top, bottom, left >> 6, (right + 63) >> 6


@part
def _trim(words, box):
    """Returns the part of a box of words in which bits are set; an empty one is (0, 0, 0, 0)."""
    top, bottom, left, right = box
    first_row, last_row, first_word, last_word = bottom, -1, right, -1
    for row in range(top, bottom):
        for k in range(left, right):
            if words[row, k] != np.uint64(0):
                first_row, last_row = min(first_row, row), row
                first_word, last_word = min(first_word, k), max(last_word, k)
    if last_row < 0:
        return np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    return first_row, last_row + 1, first_word, last_word + 1


@kernel
def draw_instances(scene, buildings, rotations, centers, view, scratch, words):
    """Draws buildings one by one; returns those that cover a pixel, their boxes, offsets and words.

    Args:
        scene: SceneArrays.
        buildings: (N,) int64 indices.
        rotations: (1, 3, 3) float64 cam_from_world.
        centers: (1, 3) float64 camera centre, local metres.
        view: View.
        scratch: Scratch.
        words: (1, H, ceil(W / 64)) uint64, clear; so it is left.
    """
    kept = np.empty(buildings.shape[0], dtype=np.int64)
    boxes = np.empty((buildings.shape[0], 4), dtype=np.int64)
    starts = np.zeros(buildings.shape[0] + 1, dtype=np.int64)
    stored = np.empty(1024, dtype=np.uint64)
    count = 0
    for n in range(buildings.shape[0]):
        b = buildings[n]
        draw_group(scene, buildings[n : n + 1], 1, rotations, centers, view, scratch, words)
        box = _bounding_box(scene.spheres[b], rotations[0], centers[0], view)
        top, bottom, left, right = _trim(words[0], box)
        if bottom == 0:
            continue
        begin = starts[count]
        stop = begin + (bottom - top) * (right - left)
        if stop > stored.shape[0]:
            larger = np.empty(2 * stop, dtype=np.uint64)
            larger[:begin] = stored[:begin]
            stored = larger
        for row in range(top, bottom):
            for k in range(left, right):
                stored[begin] = words[0, row, k]
                words[0, row, k] = np.uint64(0)
                begin += 1
        kept[count], starts[count + 1] = b, stop
        boxes[count, 0], boxes[count, 1], boxes[count, 2], boxes[count, 3] = top, bottom, left, right
        count += 1
    return (
        kept[:count].copy(),
        boxes[:count].copy(),
        starts[: count + 1].copy(),
        stored[: starts[count]].copy(),
    )
