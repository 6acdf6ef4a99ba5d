"""Coverage by counting layers: edges leave marks, one pass down the columns adds them up.

For every triangle the engine adds the winding number it has on the screen, turned positive. So the
sum at a pixel is the number of layers over it, and the silhouette is where that is not zero. It is
enough to mark, in every column an edge meets, the row where the sum changes; the pass then adds
up each column from the top. Along an edge shared by two triangles that face alike the two marks
cancel, so only the edges of the outline are marked at all. This is exact whatever the mesh: open,
closed, or with faces turned the wrong way; and buildings need not be kept apart.
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

from lodbench.kernels.arguments import LANES, STRIP
from lodbench.kernels.compiled import part
from lodbench.kernels.simd_kernels import mark_lines, set_up_lines

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
    at = lane * lists.column.shape[0] + lists.counts[lane]
    lists.left[at] = pack_corner(ua, va, weight)
    lists.right[at] = pack_corner(ub, vb, weight)
    lists.counts[lane] += 1


@part
def mark_edges(lists, lane, width, height, marks):
    """Marks a hypothesis's edges in every column they meet, and empties its list."""
    start, count = lane * lists.column.shape[0], lists.counts[lane]
    prepared = lists.weight, lists.column, lists.meets, lists.row, lists.step
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
