"""What is estimated of a photo, as one vector: its columns, and the views it stands for.

A pose (metres, degrees), by how many percent the lens is longer than declared, then metres: how much higher
than in the map all roofs are and where all walls end, and how much farther all eaves stand out. Shorter
vectors begin alike; it is also the order in which an outline says how it moves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import wrap_deg
from lodbench.geometry.angles import rotations_from_euler

Floats = NDArray[np.float64]

POSE, LENS, ROOFS, BASE_OFFSET, EAVE_OFFSET = slice(0, 6), 6, 7, 8, 9
# Of a pose: pitch and roll.
TILT = slice(3, 5)
# How many numbers a vector has: a pose, a camera, one with roofs, one with all that outlines show, all.
POSES, CAMERAS, RAISED, OUTLINES, ALL = range(6, 11)
# What a pose alone leaves out.
BESIDE_POSE = ALL - POSES
# The longest step of an optimizer: a linearisation says little beyond it (metres, degrees, percent).
_LONGEST_STEP = np.array([6.0, 6.0, 10.0, 2.0, 2.0, 4.0, 2.0])


def differences(vectors: Floats, origin: Floats) -> Floats:
    """Returns (..., N) vectors less another one or others, yaw within half a turn."""
    away = np.asarray(vectors - origin)
    away[..., 5] = wrap_deg(away[..., 5])
    return away


def shortened(step: Floats) -> Floats:
    """Returns steps of poses or cameras, (..., 6 or 7), none longer than a linearisation is good for."""
    longest = _LONGEST_STEP[: step.shape[-1]]
    too_long = np.max(np.abs(step) / longest, axis=-1, keepdims=True, initial=0.0)
    return np.asarray(step * (1.0 / np.maximum(1.0, too_long)))


def views_of(vectors: Floats) -> tuple[Floats, Floats]:
    """Returns the rotations (N, 3, 3) and centres (N, 3), metres, that show what some cameras see.

    A longer lens stretches what a camera sees across and down, and so do the first two rows of a rotation
    that are stretched: cameras of many lenses are drawn as if they had the declared one.

    Args:
        vectors: (N, 6) poses, or (N, 7 or more) with the lens.
    """
    rotations = rotations_from_euler(vectors[:, 3:6])
    # Of poses the slice is empty, and its sum 0.
    rotations[:, :2] *= 1.0 + 0.01 * vectors[:, LENS:CAMERAS].sum(axis=1)[:, None, None]
    return rotations, np.ascontiguousarray(vectors[:, :3])
