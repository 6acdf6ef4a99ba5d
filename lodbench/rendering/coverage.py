"""Coverage by counting layers: edges leave marks, one sweep down the columns sums them up.

For every triangle the engine adds the winding number it has on the screen, turned positive. So the
sum at a pixel is the number of layers over it, and the silhouette is where that is not zero. It is
enough to mark, in every column an edge meets, the row where the sum changes; the sweep then adds
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

# A sum is read as 16 bits: it is looked at before more triangles than this could pile up.
MAX_LAYERS = 30_000

_STRIP = 64


class Coverage(NamedTuple):
    """Marks of one view, in strips of 64 columns.

    Attributes:
        marks: (S * (H + 1) * 64,) int16, strip by strip, row by row: how much the sum changes at each
            pixel. Row H takes what lies below the view.
        low: (S,) int64, first marked row of each strip.
        high: (S,) int64, last marked row of each strip, -1 for none.
    """

    marks: NDArray[np.int16]
    low: NDArray[np.int64]
    high: NDArray[np.int64]


def blank_coverage(width: int, height: int) -> Coverage:
    """Returns the coverage of an empty view."""
    strips = words_per_row(width)
    return Coverage(
        np.zeros(strips * (height + 1) * _STRIP, dtype=np.int16),
        np.full(strips, height, dtype=np.int64),
        np.full(strips, -1, dtype=np.int64),
    )


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def first_centre_at(position):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the first row or column whose centre is at or after a position in sub-pixels."""
    return np.int64(np.ceil((position - 128.0) * (1.0 / 256.0)))


@njit(cache=True, nogil=True, error_model="numpy")
def expect_marks(coverage, left, right, top, bottom, width, height):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Notes that marks may follow within bounds in sub-pixels; tells whether the view sees any of them."""
    first_column = max(np.int64(0), first_centre_at(left))
    last_column = min(np.int64(width), first_centre_at(right)) - 1
    first_row = max(np.int64(0), first_centre_at(top))
    last_row = min(np.int64(height), first_centre_at(bottom))
    if first_column > last_column or first_row >= height or last_row < 1:
        return False
    for strip in range(first_column >> 6, (last_column >> 6) + 1):
        coverage.low[strip] = min(coverage.low[strip], first_row)
        coverage.high[strip] = max(coverage.high[strip], last_row)
    return True


class EdgeLines(NamedTuple):
    """Edges of a view, ready to be marked.

    Attributes:
        span: (E, 3) int32: first column met, first column no longer met, weight.
        line: (E, 3) float64: numerator at the first column, its step per column, 1 / denominator.
    """

    span: NDArray[np.int32]
    line: NDArray[np.float64]


def edge_lines(max_edges: int) -> EdgeLines:
    """Returns room for ``max_edges`` edges."""
    return EdgeLines(np.zeros((max_edges, 3), dtype=np.int32), np.zeros((max_edges, 3)))


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def add_line(lines, count, width, height, ua, va, ub, vb, weight):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Adds an edge, from snapped corner a to b, as number ``count``; returns the new number of edges.

    An edge that meets no column's centre, or lies wholly below the view, is not counted in.

    The first row at or below where an edge crosses a column is ``ceil(n / d)`` for integers n, d
    below 2**53. ``floor((n + d - 0.5) * (1 / d))`` equals it: the half keeps the real value at least
    0.5 / d (2**-32) from a whole number, and two float64 roundings of a value below 2**15 err by
    less. From column to column n changes by an integer, so stepping is exact too.
    """
    is_leftward = ua > ub
    left, right = (ub, ua) if is_leftward else (ua, ub)
    v_left, v_right = (vb, va) if is_leftward else (va, vb)
    first = max(0.0, np.ceil((left - 128.0) * (1.0 / 256.0)))
    stop = min(float(width), np.ceil((right - 128.0) * (1.0 / 256.0)))
    du, dv = right - left, v_right - v_left
    d = 256.0 * du
    lines.span[count, 0] = np.int32(first)
    lines.span[count, 1] = np.int32(stop)
    lines.span[count, 2] = -weight if is_leftward else weight
    lines.line[count, 0] = (v_left - 128.0) * du + (256.0 * first + 128.0 - left) * dv + d - 0.5
    lines.line[count, 1] = 256.0 * dv
    lines.line[count, 2] = 1.0 / d
    below = 256.0 * height
    return count + np.int64((first < stop) & ((va < below) | (vb < below)))


@njit(cache=True, nogil=True, error_model="numpy")
def mark_lines(lines, count, height, marks):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Marks the first ``count`` edges in every column they meet."""
    lowest = float(height)
    # Unsigned, so that no index needs a look at its sign.
    strip_size = np.uint64((height + 1) * _STRIP)
    for i in range(count):
        weight = np.int16(lines.span[i, 2])
        n, step, inverse = lines.line[i, 0], lines.line[i, 1], lines.line[i, 2]
        for column in range(np.uint64(lines.span[i, 0]), np.uint64(lines.span[i, 1])):
            row = np.uint64(np.int32(min(max(np.floor(n * inverse), 0.0), lowest)))
            n += step
            place = (column >> np.uint64(6)) * strip_size + row * np.uint64(_STRIP)
            marks[place + (column & np.uint64(63))] += weight


@intrinsic
def _sweep_strip(
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
def sweep(coverage, height, words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Sets the bits of ``words``, (H, S) uint64, where the sums are not zero, and clears all marks."""
    strips = coverage.low.shape[0]
    for strip in range(strips):
        low, high = coverage.low[strip], coverage.high[strip]
        if high < 0:
            continue
        start = strip * (height + 1) * _STRIP
        # The row below the view takes marks but is not looked at.
        rows = min(high, height - 1) + 1 - low
        _sweep_strip(coverage.marks, start + low * _STRIP, rows, words, low * strips + strip, strips)  # type: ignore[call-arg]
        coverage.marks[start + height * _STRIP : start + (height + 1) * _STRIP] = 0
        coverage.low[strip] = height
        coverage.high[strip] = -1
