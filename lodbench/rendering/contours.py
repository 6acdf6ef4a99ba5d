"""Rasterising weighted edges: row by row, filled wherever the sum of weights so far is not zero.

For each building the engine adds, over its triangles, the winding number each has on the screen
(turned positive), so a pixel is covered exactly where the sum is not zero. Along an edge shared
by two triangles that face alike the two contributions cancel, so only outline edges remain. The
sum is exact whatever the mesh: open, closed, or with faces turned the wrong way.

The scan keeps the edges that meet a row in a list sorted by column. Their order hardly changes
from one row to the next, so sorting costs next to nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lodbench.rendering.bits import fill_span


class EdgeList(NamedTuple):
    """Edges waiting for a scan, and the scan's own lists.

    Attributes:
        head: (H,) int32, first edge that starts in each row, or -1.
        following: (E,) int32, next edge that starts in the same row, or -1.
        stop: (E,) int32, first row the edge no longer meets.
        weight: (E,) int32, what crossing the edge from left to right adds.
        crossing: (E, 3) float64: numerator at the current row, its step per row, 1 / denominator.
        order: (E,) int32, the edges that meet the current row, left to right.
        column: (E,) int32, their columns.
    """

    head: NDArray[np.int32]
    following: NDArray[np.int32]
    stop: NDArray[np.int32]
    weight: NDArray[np.int32]
    crossing: NDArray[np.float64]
    order: NDArray[np.int32]
    column: NDArray[np.int32]


def edge_list(height: int, max_edges: int) -> EdgeList:
    """Returns an empty list for images of ``height`` rows and up to ``max_edges`` edges at a time."""
    integers = [np.zeros(max_edges, dtype=np.int32) for _ in range(5)]
    return EdgeList(
        np.full(height, -1, dtype=np.int32),
        integers[0],
        integers[1],
        integers[2],
        np.zeros((max_edges, 3)),
        integers[3],
        integers[4],
    )


@njit(cache=True, nogil=True, inline="always")
def first_row_at(v):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the first row whose centre is at or below ``v`` sub-pixels."""
    return np.int64(np.ceil((v - 128.0) * (1.0 / 256.0)))


@njit(cache=True, nogil=True, inline="always")
def add_edge(edges, count, height, ua, va, ub, vb, weight):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Adds an edge from snapped corner a to b as number ``count``; returns the new number of edges.

    The first column at or right of the crossing is ``ceil(n / d)`` for integers n, d below 2**53.
    ``floor((n + d - 0.5) * (1 / d))`` equals it: the half keeps the real value at least 0.5 / d
    (2**-32) from a whole number, and two float64 roundings of a value below 2**15 err by less.
    Stepping from row to row adds integers, so it is exact too.
    """
    if va > vb:
        ua, va, ub, vb = ub, vb, ua, va
        weight = -weight
    row = max(np.int64(0), first_row_at(va))
    stop = min(np.int64(height), first_row_at(vb))
    if row >= stop:
        return count
    du, dv = ub - ua, vb - va
    d = 256.0 * dv
    edges.crossing[count, 0] = (ua - 128.0) * dv + (256.0 * row + 128.0 - va) * du + d - 0.5
    edges.crossing[count, 1] = 256.0 * du
    edges.crossing[count, 2] = 1.0 / d
    edges.stop[count] = stop
    edges.weight[count] = weight
    edges.following[count] = edges.head[row]
    edges.head[row] = count
    return count + 1


@njit(cache=True, nogil=True)
def fill_edges(edges, first, stop, width, words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Fills the rows first <= j < stop from the edges added, and leaves the list empty."""
    order, column = edges.order, edges.column
    limit = float(width)
    active = 0
    for row in range(first, stop):
        new = edges.head[row]
        edges.head[row] = -1
        while new >= 0:
            order[active] = new
            active += 1
            new = edges.following[new]

        kept = 0
        for i in range(active):
            edge = order[i]
            if edges.stop[edge] <= row:
                continue
            n = edges.crossing[edge, 0]
            edges.crossing[edge, 0] = n + edges.crossing[edge, 1]
            c = np.int32(min(max(np.floor(n * edges.crossing[edge, 2]), 0.0), limit))
            place = kept
            while place > 0 and column[place - 1] > c:
                column[place] = column[place - 1]
                order[place] = order[place - 1]
                place -= 1
            column[place] = c
            order[place] = edge
            kept += 1
        active = kept

        winding = 0
        start = 0
        for i in range(active):
            before = winding
            winding += edges.weight[order[i]]
            if before == 0:
                start = column[i]
            elif winding == 0 and column[i] > start:
                fill_span(words, row, start, column[i])
