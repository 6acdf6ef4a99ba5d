"""Putting hypotheses in an order in which neighbours see nearly the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# A turn by this many metres' worth per radian moves the picture about as a shift does, seen from the
# height drones fly at.
_METRES_PER_RADIAN = 100.0
_BITS = 4


def nearby_order(rotations: Floats, centers: Floats) -> NDArray[np.int64]:
    """Returns an order of N poses along a Z-curve over their centres and directions (Morton 1966).

    Args:
        rotations: (N, 3, 3) cam_from_world.
        centers: (N, 3) camera centres, metres.
    """
    if len(centers) <= 1:
        return np.arange(len(centers))
    # Neighbours in the first row of the rotation, the camera's x axis, have nearly the same yaw.
    turns = rotations[:, 0, :2] * _METRES_PER_RADIAN
    places = np.concatenate([centers, turns], axis=1)
    low = places.min(axis=0)
    cell = max(float((places.max(axis=0) - low).max()) / 2**_BITS, 1e-9)
    cells = np.minimum((places - low) / cell, 2**_BITS - 1).astype(np.int64)
    key = np.zeros(len(cells), dtype=np.int64)
    for bit in range(_BITS - 1, -1, -1):
        for axis in range(cells.shape[1]):
            key = (key << 1) | ((cells[:, axis] >> bit) & 1)
    return np.argsort(key, kind="stable")
