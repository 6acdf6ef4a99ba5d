"""From an outline's edges to marks in columns, eight edges or eight columns at a time, as LLVM intrinsics."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from lodbench.rendering.simd import (
    F64,
    I16,
    I32,
    I64,
    LANES,
    Running,
    Vector,
    arrays,
    broadcast,
    constant_index,
    vector_offset,
)


@intrinsic
def set_up_lines(
    _context: Any, left: Any, right: Any, start: Any, count: Any, width: Any, weight: Any, column: Any,
    meets: Any, row: Any, step: Any,
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
        meets: (M,) int32, receives how many columns it meets.
        row: (M,) float64, receives the row at the first column.
        step: (M,) float64, receives the rows from one column to the next.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        lefts, rights, weights, columns, meet, rows, steps = arrays(
            context, builder, signature, args, (0, 1, 5, 6, 7, 8, 9)
        )
        stop_column = broadcast(builder, builder.trunc(args[4], I32))
        eights = builder.lshr(builder.add(args[3], constant_index(LANES - 1)), constant_index(3))
        with cgutils.for_range(builder, eights) as loop:
            at = vector_offset(builder, loop.index)
            here = builder.add(args[2], at)
            a, b = lefts.load(here), rights.load(here)
            low, vl, vr = a.to(I32), (a >> 32).to(I32), (b >> 32).to(I32)
            ul, ur = (low << 8) >> 8, (b.to(I32) << 8) >> 8
            first = ((ul + 127) >> 8).at_least(0)
            du, dv = (ur - ul).to(F64), (vr - vl).to(F64)
            past = ((first << 8) + 128 - ul).to(F64)
            d = du * 256.0
            inverse = d.reciprocal()
            n = (vl - 128).to(F64) * du + past * dv + d - 0.5
            rows.store(at, n * inverse)
            steps.store(at, (dv * 256.0) * inverse)
            weights.store(at, low >> 24)
            columns.store(at, first)
            meet.store(at, ((ur + 127) >> 8).at_most(stop_column) - first)
        return context.get_dummy_value()

    index = types.int64
    return types.void(left, right, index, index, index, weight, column, meets, row, step), generate


@intrinsic
def mark_lines(
    _context: Any, weight: Any, column: Any, meets: Any, row: Any, step: Any, count: Any, height: Any,
    marks: Any, spare: Any,
) -> tuple[Signature, Any]:  # fmt: skip
    """Adds each edge's weight to the marks of all columns it meets, eight columns at a time.

    Most edges meet fewer than eight. What a turn has too many goes to spare places, one for each lane: a
    loop of varying length would make the processor guess wrong once per edge, which costs more.

    Args:
        weight: (M,) int32 what to add, from here to ``step`` as ``set_up_lines`` leaves it.
        column: (M,) int32 first column of each edge.
        meets: (M,) int32 how many columns it meets.
        row: (M,) float64 row at the first column.
        step: (M,) float64 rows from one column to the next.
        count: How many edges.
        height: Rows of the view; marks outside go to row 0 and row ``height``.
        marks: int16, strips of 64 columns of ``height + 1`` rows.
        spare: Where in ``marks`` eight spare places are.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        weights, columns, meet, rows, steps, places = arrays(
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
                meet.broadcast(k),
                rows.broadcast(k),
                steps.broadcast(k),
            )
            weight = builder.trunc(weights.load_scalar(k), I16)
            turns = builder.lshr(
                builder.add(meet.load_scalar(k), ir.Constant(I32, LANES - 1)), ir.Constant(I32, 3)
            )
            place_in_edge = Running(builder, numbers.value)
            with cgutils.for_range(builder, turns):
                i = Vector(builder, place_in_edge.get())
                c = first + i
                y = (row + step * i.to(F64)).at_least(0.0).at_most(lowest).to(I32)
                place = (c >> 6) * strip_size + (y << 6) + (c & 63)
                place = place.where(i.compare("<", number), spares)
                for lane in range(LANES):
                    index = builder.zext(place.extract(lane), I64)
                    places.store_scalar(index, builder.add(places.load_scalar(index), weight))
                place_in_edge.set((i + LANES).value)
        return context.get_dummy_value()

    index = types.int64
    return types.void(weight, column, meets, row, step, index, index, marks, index), generate
