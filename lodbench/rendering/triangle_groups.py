"""Loose triangles as a scene whose "buildings" are groups of neighbours, for the raster to skip whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene

Floats = NDArray[np.float64]

# Triangles are drawn in groups by squares of the plan: small, so that few are projected in vain.
_CELL_M = 32.0


def triangle_groups(corners: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns an order of (T, 3, 3) triangles by squares of the plan, and where each square's begin."""
    middle = corners[:, :, :2].mean(axis=1)
    cell = np.floor((middle - middle.min(axis=0)) / _CELL_M).astype(np.int64)
    key = cell[:, 1] * (int(cell[:, 0].max()) + 1) + cell[:, 0]
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    return order, np.append(starts, len(order))


def grouped_scene(corners: Floats, starts: NDArray[np.int64]) -> Scene:
    """Returns grouped triangles as a scene; every group has vertices of its own."""
    count = len(starts) - 1
    group = np.repeat(np.arange(count), 3 * np.diff(starts))
    points = corners.reshape(-1, 3).astype(np.float32)
    # Several times as fast as unique rows of a structured array.
    order = np.lexsort((points[:, 2], points[:, 1], points[:, 0], group))
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = (np.diff(group[order]) != 0) | (points[order[1:]] != points[order[:-1]]).any(axis=1)
    first, triangles = order[is_new], np.empty(len(order), dtype=np.int32)
    triangles[order] = np.cumsum(is_new) - 1
    return Scene(
        vertices=points[first],
        triangles=triangles.reshape(-1, 3),
        vertex_starts=np.searchsorted(group[first], np.arange(count + 1)).astype(np.int64),
        triangle_starts=starts.astype(np.int64),
        building_ids=tuple(str(number) for number in range(count)),
        lod="",
        crs=None,
        origin=np.zeros(3),
    )
