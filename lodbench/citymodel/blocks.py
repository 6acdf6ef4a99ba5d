"""A scene of plain blocks: what trials look at where no city model is at hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene, build_scene

# A block's corners count x, y, z in binary; no floor.
_FACES = np.array([(0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5), (1, 5, 7, 3)])


def scene_of_blocks(
    blocks: Sequence[tuple[float, float, float, float, float, float]],
    origin: NDArray[np.float64] | None = None,
) -> Scene:
    """Returns a scene of upright blocks, one building each.

    Args:
        blocks: West, south, east, north, base and top of each, metres.
        origin: (3,) origin to record, zero by default.
    """
    corners = [
        (x, y, z)
        for west, south, east, north, base, top in blocks
        for x in (west, east)
        for y in (south, north)
        for z in (base, top)
    ]
    faces = np.concatenate([8 * k + _FACES for k in range(len(blocks))])
    triangles = faces[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    building = np.repeat(np.arange(len(blocks), dtype=np.int32), 2 * len(_FACES))
    names = tuple(f"block {k}" for k in range(1, len(blocks) + 1))
    return build_scene(np.array(corners), triangles, building, names, origin=origin)
