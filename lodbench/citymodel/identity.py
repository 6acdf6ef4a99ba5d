"""Equal rows: numbering them in the order they first occur, by one sort of 64-bit hashes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Odd constants with well spread bits (from the golden ratio and the splitmix64 finaliser).
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)
_MIXER = np.uint64(0xBF58476D1CE4E5B9)
_SHIFT = np.uint64(31)


def number_rows(columns: list[NDArray[np.uint64]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns a number for every row, equal for equal rows, and the first row of each number.

    Numbers count up in the order of first occurrence.

    Args:
        columns: Arrays (N,) of bits; a row is one entry of each.

    Returns:
        numbers: (N,) int64.
        first: (U,) int64 ascending.

    Example:
        >>> number_rows([np.array([7, 5, 7], np.uint64)])[0]
        array([0, 1, 0])
    """
    key = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        key = (key ^ column) * _MULTIPLIER
        key = (key ^ (key >> _SHIFT)) * _MIXER
    order = np.argsort(key, kind="stable")
    is_new = _changes([key], order)
    if not np.array_equal(is_new, _changes(columns, order)):
        # Two rows share a hash: sort by the rows themselves.
        order = np.lexsort(columns)
        is_new = _changes(columns, order)
    group = np.cumsum(is_new) - 1
    first = order[is_new]  # a stable sort keeps the earliest row of a group in front
    by_occurrence = np.argsort(first)
    rank = np.empty_like(by_occurrence)
    rank[by_occurrence] = np.arange(len(first))
    numbers = np.empty(len(order), np.int64)
    numbers[order] = rank[group]
    return numbers, first[by_occurrence]


def _changes(columns: list[NDArray[np.uint64]], order: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tells where a row differs from the one before it in the given order."""
    is_new = np.zeros(len(order), np.bool_)
    is_new[:1] = True
    for column in columns:
        ordered = column[order]
        is_new[1:] |= ordered[1:] != ordered[:-1]
    return is_new


def point_bits(points: NDArray[np.floating]) -> list[NDArray[np.uint64]]:
    """Returns the bits of points, (N, 3) of any float type, as three columns; -0.0 counts as 0.0."""
    word = np.uint32 if points.dtype == np.float32 else np.uint64
    bits = np.ascontiguousarray((points + points.dtype.type(0)).T).view(word)
    return [column.astype(np.uint64) for column in bits]


def connected_components(
    num_nodes: int, first: NDArray[np.int64], second: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Returns the smallest node of each node's component.

    Args:
        num_nodes: Nodes are 0 .. num_nodes - 1.
        first: (E,) one end of every edge.
        second: (E,) the other end.
    """
    from scipy.sparse import coo_array, csgraph

    edges = coo_array((np.ones(len(first), np.bool_), (first, second)), shape=(num_nodes, num_nodes))
    count, labels = csgraph.connected_components(edges, directed=False)
    smallest: NDArray[np.int64] = np.full(count, num_nodes, np.int64)
    np.minimum.at(smallest, labels, np.arange(num_nodes))
    return np.asarray(smallest[labels])
