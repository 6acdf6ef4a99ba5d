"""Coverage by counting layers: edges leave marks, one pass down the columns adds them up.

For every triangle the engine adds the winding number it has on the screen, turned positive. So the
sum at a pixel is the number of layers over it, and the silhouette is where that is not zero. It is
enough to mark, in every column an edge meets, the row where the sum changes; the pass then adds
up each column from the top. Along an edge shared by two triangles that face alike the two marks
cancel, so only the edges of the outline are marked at all. This is exact whatever the mesh: open,
closed, or with faces turned the wrong way; and buildings need not be kept apart.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.typing.templates import Signature
from numba.extending import intrinsic
from numba.np.arrayobj import make_array
from numpy.typing import NDArray

from lodbench.rendering.bits import words_per_row
from lodbench.rendering.simd import LANES
from lodbench.rendering.simd_marks import mark_lines, set_up_lines

# A sum is read as 16 bits: it is looked at before more triangles than this could add up.
MAX_LAYERS = 30_000

_STRIP = 64


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


def blank_coverage(width: int, height: int) -> Coverage:
    """Returns the coverage of an empty view."""
    strips = words_per_row(width)
    return Coverage(
        np.zeros(strips * (height + 1) * _STRIP + LANES, dtype=np.int16),
        np.full((LANES, strips), height, dtype=np.int64),
        np.full((LANES, strips), -1, dtype=np.int64),
    )


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def first_centre_at(position):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the first row or column whose centre is at or after a position in sub-pixels."""
    return (np.int64(position) + 127) >> 8


@njit(cache=True, nogil=True, error_model="numpy")
def expect_marks(coverage, lane, left, right, top, bottom, width, height):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
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


class EdgeLists(NamedTuple):
    """Outline edges of eight hypotheses, and room to prepare those of one for marking.

    Attributes:
        left: (8 * capacity,) int64, list after list: each edge's left corner and weight, see
            ``pack_corner``.
        right: Likewise its right corner.
        counts: (8,) int64 lengths of the lists.
        weight: (capacity,) int32 what the sum changes by below an edge.
        column: (capacity,) int32 first column an edge meets.
        meets: (capacity,) int32 how many columns it meets.
        row: (capacity,) float64 row at the first column.
        step: (capacity,) float64 rows from one column to the next.
    """

    left: NDArray[np.int64]
    right: NDArray[np.int64]
    counts: NDArray[np.int64]
    weight: NDArray[np.int32]
    column: NDArray[np.int32]
    meets: NDArray[np.int32]
    row: NDArray[np.float64]
    step: NDArray[np.float64]


def edge_lists(capacity: int) -> EdgeLists:
    """Returns empty lists with room for ``capacity`` edges each, a multiple of 8."""
    return EdgeLists(
        np.zeros(LANES * capacity, dtype=np.int64),
        np.zeros(LANES * capacity, dtype=np.int64),
        np.zeros(LANES, dtype=np.int64),
        np.zeros(capacity, dtype=np.int32),
        np.zeros(capacity, dtype=np.int32),
        np.zeros(capacity, dtype=np.int32),
        np.zeros(capacity),
        np.zeros(capacity),
    )


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def pack_corner(u, v, weight):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns a snapped corner, each way within 2**23, and a weight in [-128, 127] as one int64.

    From the top: 32 bits row, 8 bits weight, 24 bits column.
    """
    return (np.int64(v) << 32) | ((np.int64(weight) & 0xFF) << 24) | (np.int64(u) & 0xFFFFFF)


@njit(cache=True, nogil=True, error_model="numpy")
def append_edge(lists, lane, width, ua, va, ub, vb, weight):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Appends an edge from snapped corner a to b to a hypothesis's list, unless it meets no column."""
    if ua > ub:
        ua, va, ub, vb, weight = ub, vb, ua, va, -weight
    if max(first_centre_at(ua), 0) >= min(first_centre_at(ub), width):
        return
    at = lane * lists.column.shape[0] + lists.counts[lane]
    lists.left[at] = pack_corner(ua, va, weight)
    lists.right[at] = pack_corner(ub, vb, weight)
    lists.counts[lane] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def mark_edges(lists, lane, width, height, marks):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Marks a hypothesis's edges in every column they meet, and empties its list."""
    start, count = lane * lists.column.shape[0], lists.counts[lane]
    prepared = lists.weight, lists.column, lists.meets, lists.row, lists.step
    set_up_lines(lists.left, lists.right, start, count, width, *prepared)  # type: ignore[call-arg]
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
            make_array(signature.args[i])(context, builder, args[i]).data  # type: ignore[no-untyped-call]
            for i in (0, 3)
        )
        vector = ir.VectorType(ir.IntType(16), _STRIP)
        zero = ir.Constant(vector, [0] * _STRIP)
        sums = cgutils.alloca_once_value(builder, zero)  # type: ignore[no-untyped-call]
        with cgutils.for_range(builder, args[2]) as loop:
            offset = builder.add(args[1], builder.mul(loop.index, ir.Constant(loop.index.type, _STRIP)))
            here = builder.bitcast(builder.gep(marks_data, [offset]), vector.as_pointer())
            total = builder.add(builder.load(sums), builder.load(here, align=2))
            builder.store(total, sums)
            builder.store(zero, here, align=2)
            bits = builder.bitcast(builder.icmp_signed("!=", total, zero), ir.IntType(64))
            word = builder.gep(words_data, [builder.add(args[4], builder.mul(loop.index, args[5]))])
            builder.store(builder.or_(builder.load(word), bits), word)
        return context.get_dummy_value()

    return types.void(marks, types.int64, types.int64, words, types.int64, types.int64), generate


@njit(cache=True, nogil=True, error_model="numpy")
def accumulate(coverage, lane, height, words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Sets the bits of ``words``, (H, S) uint64, where a hypothesis's sums are not zero; clears all marks."""
    strips = coverage.low.shape[1]
    for strip in range(strips):
        low, high = coverage.low[lane, strip], coverage.high[lane, strip]
        if high < 0:
            continue
        start = strip * (height + 1) * _STRIP
        # The row below the view takes marks but is not looked at.
        rows = min(high, height - 1) + 1 - low
        _accumulate_strip(coverage.marks, start + low * _STRIP, rows, words, low * strips + strip, strips)  # type: ignore[call-arg]
        coverage.marks[start + height * _STRIP : start + (height + 1) * _STRIP] = 0
        coverage.low[lane, strip] = height
        coverage.high[lane, strip] = -1
