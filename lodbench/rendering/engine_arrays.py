"""Blank working memory of the silhouette engine: lists of edges, marks, and what eight hypotheses need."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.kernels.arguments import Coverage, EdgeLists, SceneArrays, Scratch
from lodbench.kernels.coverage import STRIP
from lodbench.kernels.projection import BRANCH, MAX_CORNERS
from lodbench.kernels.simd import LANES
from lodbench.rendering.bits import words_per_row

Floats = NDArray[np.float64]
Indices = NDArray[np.uint32]

# Room in a hypothesis's list of edges: more than most views have, and small enough for the cache.
_LIST_CAPACITY = 8192


def blank_scratch(scene: SceneArrays, width: int, height: int) -> Scratch:
    """Returns working memory for a scene and a size of image, pixels."""
    vertices, triangles, edges = (int(n) for n in np.diff(scene.starts, axis=0).max(axis=0, initial=0))
    capacity = max(_LIST_CAPACITY, -(-(edges + 1) // LANES) * LANES)
    return Scratch(
        poses=np.zeros(12 * LANES),
        u=np.zeros(LANES * vertices, dtype=np.int32),
        v=np.zeros(LANES * vertices, dtype=np.int32),
        extent=np.zeros(4 * LANES),
        nearest=np.zeros(LANES),
        facing=np.zeros(LANES * triangles, dtype=np.int32),
        lists=edge_lists(capacity),
        coverage=blank_coverage(width, height),
        # Not filled: of a large city most of it is never touched.
        seen=np.zeros((2, len(scene.order) + BRANCH), dtype=np.int64),
        polygons=np.zeros((2, MAX_CORNERS, 3)),
    )


def blank_coverage(width: int, height: int) -> Coverage:
    """Returns the coverage of an empty view."""
    strips = words_per_row(width)
    return Coverage(
        np.zeros(strips * (height + 1) * STRIP + LANES, dtype=np.int16),
        np.full((LANES, strips), height, dtype=np.int64),
        np.full((LANES, strips), -1, dtype=np.int64),
    )


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
