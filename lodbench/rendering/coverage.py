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
        marks: (S, H + 1, 64) int16, how much the sum changes at each pixel; row H takes what lies below.
        sums: (64,) int16, the sweep's running sums.
        low: (S,) int64, first marked row of each strip.
        high: (S,) int64, last marked row of each strip, -1 for none.
    """

    marks: NDArray[np.int16]
    sums: NDArray[np.int16]
    low: NDArray[np.int64]
    high: NDArray[np.int64]


def blank_coverage(width: int, height: int) -> Coverage:
    """Returns the coverage of an empty view."""
    strips = words_per_row(width)
    return Coverage(
        np.zeros((strips, height + 1, _STRIP), dtype=np.int16),
        np.zeros(_STRIP, dtype=np.int16),
        np.full(strips, height, dtype=np.int64),
        np.full(strips, -1, dtype=np.int64),
    )


@njit(cache=True, nogil=True, inline="always")
def first_centre_at(position):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the first row or column whose centre is at or after a position in sub-pixels."""
    return np.int64(np.ceil((position - 128.0) * (1.0 / 256.0)))


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def mark_edge(marks, width, height, ua, va, ub, vb, weight):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Marks where an edge, from snapped corner a to b, meets each column's centre.

    The first row at or below the crossing is ``ceil(n / d)`` for integers n, d below 2**53.
    ``floor((n + d - 0.5) * (1 / d))`` equals it: the half keeps the real value at least 0.5 / d
    (2**-32) from a whole number, and two float64 roundings of a value below 2**15 err by less.
    """
    if ua > ub:
        ua, va, ub, vb = ub, vb, ua, va
        weight = -weight
    first = max(np.int64(0), first_centre_at(ua))
    stop = min(np.int64(width), first_centre_at(ub))
    if first >= stop:
        return
    du, dv = ub - ua, vb - va
    d = 256.0 * du
    inverse = 1.0 / d
    step = 256.0 * dv
    n = (va - 128.0) * du + (256.0 * first + 128.0 - ua) * dv + d - 0.5
    lowest = float(height)
    change = np.int16(weight)
    for column in range(first, stop):
        row = np.int64(min(max(np.floor((n + float(column - first) * step) * inverse), 0.0), lowest))
        marks[column >> 6, row, column & 63] += change


@intrinsic
def _sweep_row(_context: Any, marks: Any, index: Any, sums: Any) -> tuple[Signature, Any]:
    """Adds 64 marks to the running sums, clears them, and returns a bit per sum that is not zero.

    Written for LLVM directly, because it turns this comparison of a whole vector into a bit mask in
    a few instructions, and finds no such thing in a loop.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = ir.VectorType(ir.IntType(16), _STRIP)
        zero = ir.Constant(vector, [0] * _STRIP)
        marks_array, sums_array = (
            make_array(signature.args[i])(context, builder, args[i])  # type: ignore[no-untyped-call]
            for i in (0, 2)
        )
        here = builder.bitcast(builder.gep(marks_array.data, [args[1]]), vector.as_pointer())
        total = builder.bitcast(sums_array.data, vector.as_pointer())
        result = builder.add(builder.load(total, align=2), builder.load(here, align=2))
        builder.store(result, total, align=2)
        builder.store(zero, here, align=2)
        return builder.bitcast(builder.icmp_signed("!=", result, zero), ir.IntType(64))

    return types.uint64(marks, types.int64, sums), generate


@njit(cache=True, nogil=True)
def sweep(coverage, height, words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Sets the bits of ``words``, (H, S) uint64, where the sums are not zero, and clears all marks."""
    marks = coverage.marks
    for strip in range(marks.shape[0]):
        low, high = coverage.low[strip], coverage.high[strip]
        if high < 0:
            continue
        coverage.sums[:] = 0
        start = strip * (height + 1) * _STRIP
        for row in range(low, min(high, height - 1) + 1):
            words[row, strip] |= _sweep_row(marks, start + row * _STRIP, coverage.sums)  # type: ignore[call-arg]
        marks[strip, height, :] = 0
        coverage.low[strip] = height
        coverage.high[strip] = -1
