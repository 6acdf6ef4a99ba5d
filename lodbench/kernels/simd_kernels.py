"""From vertices to outlines, eight hypotheses side by side, as LLVM intrinsics.

Arrays that hold eight hypotheses are flat: element ``8 i + lane``. Hypotheses see the same vertices,
triangles and edges, so no lane ever waits for another, and no index differs between lanes.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from lodbench.kernels.arguments import LANES
from lodbench.kernels.simd import (
    BIT,
    F64,
    I16,
    I32,
    I64,
    Memory,
    Running,
    Vector,
    arrays,
    broadcast,
    constant_index,
    vector_offset,
)


@intrinsic
def project_vertices(
    _context: Any, x: Any, y: Any, z: Any, first: Any, stop: Any, poses: Any, intrinsics: Any, u: Any, v: Any,
    extent: Any, nearest: Any,
) -> tuple[Signature, Any]:  # fmt: skip
    """Projects vertices for eight poses: raster rules 1 and 3.

    Args:
        x: (V,) float32 local metres; likewise y and z.
        y: See x.
        z: See x.
        first: First vertex.
        stop: Behind the last vertex.
        poses: (12 * 8,) float64, a rotation's nine and a centre's three numbers.
        intrinsics: (4,) float64 fx, fy, cx, cy.
        u: (>= 8 (stop - first),) int32, receives snapped columns, anything if outside 32 bits; likewise v
            rows.
        v: See u.
        extent: (4 * 8,) float64, receives least u, greatest u, least v, greatest v.
        nearest: (8,) float64, receives the least distance along the optical axis, metres.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        xs, ys, zs, pose, focal, us, vs, extents, depths = arrays(
            context, builder, signature, args, (0, 1, 2, 5, 6, 7, 8, 9, 10)
        )
        r = [pose.load(constant_index(LANES * i)) for i in range(9)]
        c = [pose.load(constant_index(LANES * i)) for i in range(9, 12)]
        # Times a power of two: exact, and the same at every step as multiplying at the end.
        f = [focal.broadcast(constant_index(i)) * 256.0 for i in range(4)]
        highest = ir.Constant(ir.VectorType(F64, LANES), [float("inf")] * LANES)
        lowest = ir.Constant(highest.type, [-float("inf")] * LANES)
        bounds = [Running(builder, start) for start in (highest, lowest, highest, lowest)]
        near = Running(builder, highest)
        with cgutils.for_range(builder, builder.sub(args[4], args[3])) as loop:
            k = builder.add(args[3], loop.index)
            dx, dy, dz = xs.broadcast(k) - c[0], ys.broadcast(k) - c[1], zs.broadcast(k) - c[2]
            px, py, pz = ((r[3 * i] * dx + r[3 * i + 1] * dy) + r[3 * i + 2] * dz for i in range(3))
            inverse = pz.reciprocal()
            at = vector_offset(builder, loop.index)
            screen = ((f[0] * px) * inverse + f[2], us), ((f[1] * py) * inverse + f[3], vs)
            for i, (position, memory) in enumerate(screen):
                snapped = (position + 0.5).floor()
                memory.store(at, snapped.low_bits())
                low, high = bounds[2 * i], bounds[2 * i + 1]
                low.set(snapped.at_most(Vector(builder, low.get())).value)
                high.set(snapped.at_least(Vector(builder, high.get())).value)
            near.set(pz.at_most(Vector(builder, near.get())).value)
        for i, bound in enumerate(bounds):
            extents.store(constant_index(LANES * i), Vector(builder, bound.get()))
        depths.store(constant_index(0), Vector(builder, near.get()))
        return context.get_dummy_value()

    index = types.int64
    return types.void(x, y, z, index, index, poses, intrinsics, u, v, extent, nearest), generate


@intrinsic
def face_triangles(
    _context: Any,
    corner_a: Any,
    corner_b: Any,
    corner_c: Any,
    first: Any,
    stop: Any,
    u: Any,
    v: Any,
    facing: Any,
) -> tuple[Signature, Any]:
    """Writes the orientation of triangles on the screen, +1, -1 or 0, for eight hypotheses.

    Args:
        corner_a: (T,) uint32 vertex in ``u`` and ``v``; likewise corner_b and corner_c.
        corner_b: See corner_a.
        corner_c: See corner_a.
        first: First triangle.
        stop: Behind the last triangle.
        u: (8 N,) int32 snapped columns, within 2**24; likewise v rows.
        v: See u.
        facing: (>= 8 (stop - first),) int32, receives the signs.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        a, b, c, us, vs, signs = arrays(context, builder, signature, args, (0, 1, 2, 5, 6, 7))
        with cgutils.for_range(builder, builder.sub(args[4], args[3])) as loop:
            k = builder.add(args[3], loop.index)
            corners = [
                vector_offset(builder, builder.zext(corner.load_scalar(k), I64)) for corner in (a, b, c)
            ]
            (ua, va), (ub, vb), (uc, vc) = ((us.load(at), vs.load(at)) for at in corners)
            sides = [side.to(I64) for side in (ub - ua, vc - va, uc - ua, vb - va)]
            area = sides[0] * sides[1] - sides[2] * sides[3]
            sign = area.compare(">", 0).to(I32) - area.compare("<", 0).to(I32)
            signs.store(vector_offset(builder, loop.index), sign)
        return context.get_dummy_value()

    index = types.int64
    return types.void(corner_a, corner_b, corner_c, index, index, u, v, facing), generate


@intrinsic
def collect_outline(
    _context: Any, tail: Any, head: Any, side_a: Any, side_b: Any, second_weight: Any, first: Any, stop: Any,
    facing: Any, u: Any, v: Any, active: Any, width: Any, height: Any, left: Any, right: Any, counts: Any,
    capacity: Any,
) -> tuple[Signature, Any]:  # fmt: skip
    """Appends, for each of eight hypotheses, the edges whose triangles do not cancel out.

    An edge that meets no column's centre, or lies wholly below the view, is left out.

    Args:
        tail: (E,) uint32 vertex each edge starts from; likewise head.
        head: See tail.
        side_a: (E,) uint32 first triangle beside each edge; likewise side_b the second.
        side_b: See side_a.
        second_weight: (E,) int32.
        first: First edge.
        stop: Behind the last edge.
        facing: (8 T,) int32 signs of triangles.
        u: (8 N,) int32 snapped columns; likewise v rows.
        v: See u.
        active: Bit mask of the hypotheses that take part.
        width: Pixels.
        height: Pixels.
        left: (8 * capacity,) int64, list after list, receives left corners, see ``pack_corner``.
        right: Likewise right corners.
        counts: (8,) int64 lengths of the lists, updated.
        capacity: Room in each list; each must have room for all edges and one more.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        edges = arrays(context, builder, signature, args, range(5))
        signs, us, vs = arrays(context, builder, signature, args, (7, 8, 9))
        lists = arrays(context, builder, signature, args, (13, 14))
        lengths = Memory(context, builder, signature.args[15], args[15])
        takes_part = Vector(
            builder,
            builder.bitcast(builder.trunc(args[10], ir.IntType(LANES)), ir.VectorType(BIT, LANES)),
        )
        stop_column = broadcast(builder, builder.trunc(args[11], I32))
        bottom = broadcast(builder, builder.shl(builder.trunc(args[12], I32), ir.Constant(I32, 8)))
        list_ends = []
        for lane in range(LANES):
            begin = builder.mul(args[16], constant_index(lane))
            list_ends.append(Running(builder, builder.add(begin, lengths.load_scalar(constant_index(lane)))))
        with cgutils.for_range(builder, builder.sub(args[6], args[5])) as loop:
            k = builder.add(args[5], loop.index)
            i, j, side_one, side_two = (
                vector_offset(builder, builder.zext(edges[n].load_scalar(k), I64)) for n in range(4)
            )
            sum_here = signs.load(side_one) + edges[4].broadcast(k) * signs.load(side_two)
            is_outline = sum_here.compare("!=", 0) & takes_part
            with builder.if_then(
                builder.icmp_unsigned("!=", is_outline.bits(), ir.Constant(ir.IntType(8), 0))
            ):
                fields, is_met = _in_view(us, vs, (i, j), sum_here, stop_column, bottom)
                _append(builder, lists, list_ends, fields, is_outline & is_met)
        for lane in range(LANES):
            begin = builder.mul(args[16], constant_index(lane))
            lengths.store_scalar(constant_index(lane), builder.sub(list_ends[lane].get(), begin))
        return context.get_dummy_value()

    index = types.int64
    return types.void(
        tail, head, side_a, side_b, second_weight, index, index, facing, u, v, index, index, index, left,
        right, counts, index,
    ), generate  # fmt: skip


def _in_view(
    us: Memory, vs: Memory, ends: tuple[Any, Any], weight: Vector, stop_column: Vector, bottom: Vector
) -> tuple[tuple[Vector, Vector], Vector]:
    """Returns an edge's left and right corner, packed, and whether it meets a column's centre in the view.

    Args:
        us: Columns.
        vs: Rows.
        ends: Where the edge's tail and head are in them.
        weight: What the sum changes by below the edge where it runs to the right.
        stop_column: Width of the view.
        bottom: The first row below it, in the units of ``vs``.
    """
    i, j = ends
    ui, vi, uj, vj = us.load(i), vs.load(i), us.load(j), vs.load(j)
    leftward = ui.compare(">", uj)
    ul, ur = uj.where(leftward, ui), ui.where(leftward, uj)
    vl, vr = vj.where(leftward, vi), vi.where(leftward, vj)
    signed_weight = (weight * -1).where(leftward, weight)
    first_column = ((ul + 127) >> 8).at_least(0)
    end_column = ((ur + 127) >> 8).at_most(stop_column)
    is_met = first_column.compare("<", end_column) & vl.at_most(vr).compare("<", bottom)
    return (_packed(ul, vl, signed_weight), _packed(ur, vr, signed_weight)), is_met


def _packed(u: Vector, v: Vector, weight: Vector) -> Vector:
    """Returns corners as ``pack_corner`` does."""
    low = (u & 0xFFFFFF) | (weight << 24)
    return (v.to(I64) << 32) | (low.to(I64) & 0xFFFFFFFF)


def _append(
    builder: Any, lists: list[Memory], list_ends: list[Running], fields: tuple[Vector, ...], kept: Vector
) -> None:
    """Writes each lane's fields at its list's end; the end moves on where the lane is kept."""
    increments = kept.to(I64)
    for lane, list_end in enumerate(list_ends):
        at = list_end.get()
        for memory, field in zip(lists, fields, strict=True):
            memory.store_scalar(at, field.extract(lane))
        list_end.set(builder.add(at, increments.extract(lane)))


@intrinsic
def set_up_lines(
    _context: Any, left: Any, right: Any, start: Any, count: Any, width: Any, weight: Any, column: Any,
    num_columns: Any, row: Any, step: Any,
) -> tuple[Signature, Any]:  # fmt: skip
    """Prepares edges for marking, eight at a time.

    The first row at or below where an edge crosses a column is ``ceil(n / d)`` for integers n, d below
    2**53. It is the floor of ``(n + d - 0.5) / d``: the half keeps this value at least 0.5 / d, which is
    2**-31 or more, from a whole number. A row is below 2**14, so ``row + step * i`` with its five
    roundings is right to 2**-36, and its floor is that of the exact value.

    Args:
        left: (N,) int64 left corners, see ``pack_corner``; likewise right.
        right: See left.
        start: First edge.
        count: How many edges; up to seven more are read and written.
        width: Pixels.
        weight: (M,) int32, receives what the sum changes by below each edge.
        column: (M,) int32, receives from 0 on the first column each edge meets.
        num_columns: (M,) int32, receives how many columns it meets.
        row: (M,) float64, receives the row at the first column.
        step: (M,) float64, receives the rows from one column to the next.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        lefts, rights, weights, columns, columns_met, rows, steps = arrays(
            context, builder, signature, args, (0, 1, 5, 6, 7, 8, 9)
        )
        stop_column = broadcast(builder, builder.trunc(args[4], I32))
        num_groups = builder.lshr(builder.add(args[3], constant_index(LANES - 1)), constant_index(3))
        with cgutils.for_range(builder, num_groups) as loop:
            at = vector_offset(builder, loop.index)
            here = builder.add(args[2], at)
            a, b = lefts.load(here), rights.load(here)
            low, vl, vr = a.to(I32), (a >> 32).to(I32), (b >> 32).to(I32)
            ul, ur = (low << 8) >> 8, (b.to(I32) << 8) >> 8
            first = ((ul + 127) >> 8).at_least(0)
            du, dv = (ur - ul).to(F64), (vr - vl).to(F64)
            offset = ((first << 8) + 128 - ul).to(F64)
            d = du * 256.0
            inverse = d.reciprocal()
            n = (vl - 128).to(F64) * du + offset * dv + d - 0.5
            rows.store(at, n * inverse)
            steps.store(at, (dv * 256.0) * inverse)
            weights.store(at, low >> 24)
            columns.store(at, first)
            columns_met.store(at, ((ur + 127) >> 8).at_most(stop_column) - first)
        return context.get_dummy_value()

    index = types.int64
    return types.void(left, right, index, index, index, weight, column, num_columns, row, step), generate


@intrinsic
def mark_lines(
    _context: Any, weight: Any, column: Any, num_columns: Any, row: Any, step: Any, count: Any, height: Any,
    marks: Any, spare: Any,
) -> tuple[Signature, Any]:  # fmt: skip
    """Adds each edge's weight to the marks of all columns it meets, eight columns at a time.

    Most edges meet fewer than eight. What a turn has too many goes to spare places, one for each lane: a
    loop of varying length would make the processor guess wrong once per edge, which costs more.

    Args:
        weight: (M,) int32 what to add, from here to ``step`` as ``set_up_lines`` leaves it.
        column: (M,) int32 first column of each edge.
        num_columns: (M,) int32 how many columns it meets.
        row: (M,) float64 row at the first column.
        step: (M,) float64 rows from one column to the next.
        count: How many edges.
        height: Rows of the view; marks outside go to row 0 and row ``height``.
        marks: int16, strips of 64 columns of ``height + 1`` rows.
        spare: Where in ``marks`` eight spare places are.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        weights, columns, columns_met, rows, steps, all_marks = arrays(
            context, builder, signature, args, (0, 1, 2, 3, 4, 7)
        )
        numbers = Vector(builder, ir.Constant(ir.VectorType(I32, LANES), list(range(LANES))))
        lowest = broadcast(builder, builder.sitofp(args[6], F64))
        rows_of_strip = builder.trunc(builder.add(args[6], constant_index(1)), I32)
        strip_size = broadcast(builder, rows_of_strip) << 6
        spares = broadcast(builder, builder.trunc(args[8], I32)) + numbers
        with cgutils.for_range(builder, args[5]) as loop:
            k = loop.index
            first, number, row, step = (
                columns.broadcast(k),
                columns_met.broadcast(k),
                rows.broadcast(k),
                steps.broadcast(k),
            )
            weight = builder.trunc(weights.load_scalar(k), I16)
            num_groups = builder.lshr(
                builder.add(columns_met.load_scalar(k), ir.Constant(I32, LANES - 1)), ir.Constant(I32, 3)
            )
            column_in_edge = Running(builder, numbers.value)
            with cgutils.for_range(builder, num_groups):
                i = Vector(builder, column_in_edge.get())
                c = first + i
                y = (row + step * i.to(F64)).at_least(0.0).at_most(lowest).to(I32)
                cell = (c >> 6) * strip_size + (y << 6) + (c & 63)
                cell = cell.where(i.compare("<", number), spares)
                for lane in range(LANES):
                    index = builder.zext(cell.extract(lane), I64)
                    all_marks.store_scalar(index, builder.add(all_marks.load_scalar(index), weight))
                column_in_edge.set((i + LANES).value)
        return context.get_dummy_value()

    index = types.int64
    return types.void(weight, column, num_columns, row, step, index, index, marks, index), generate
