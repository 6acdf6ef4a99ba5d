"""Which frame a published dataset comes in, told by what stands upright in it.

The Swiss city model was once turned into earth-centred coordinates, minus those of an origin; whether a
download still is, its files do not say. Walls do: their normals are level in the frame that has the
true vertical. Cameras do too: a gimbal keeps the picture's x axis level.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import Pose
from lodbench.geometry.frames import ShiftedEcef, enu_from_ecef_rotation

if TYPE_CHECKING:
    from lodbench.citymodel.scene import Scene

ENU, SHIFTED_ECEF = "enu", "shifted_ecef"

# A wall leans by no more than this: 2 degrees.
_WALL_SINE = 0.035
# Walls are at least this share of a city's area, and this many times what another frame shows.
_LEAST_WALLS, _CLEARLY_MORE = 0.15, 3.0
# The x axis of a gimbal's picture is level to about 6 degrees.
_LEVEL_SINE = 0.1


def frame_of_city(scene: Scene, ecef: ShiftedEcef) -> str | None:
    """Returns ``enu`` or ``shifted_ecef`` by the walls of a city, or None if they do not tell."""
    corners = scene.vertices.astype(np.float64)[scene.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    shares = {
        name: float(area[np.abs(normals @ up) < _WALL_SINE * area].sum() / area.sum())
        for name, up in _verticals(ecef).items()
    }
    best, other = sorted(shares, key=lambda name: -shares[name])
    is_clear = shares[best] >= _LEAST_WALLS and shares[best] > _CLEARLY_MORE * shares[other]
    return best if is_clear else None


def frame_of_poses(poses: Iterable[Pose], ecef: ShiftedEcef) -> str | None:
    """Returns ``enu`` or ``shifted_ecef`` by the level of the pictures, or None if it does not tell."""
    sideways = np.array([pose.rotation[0] for pose in poses])
    if len(sideways) == 0:
        return None
    tilt = {name: float(np.median(np.abs(sideways @ up))) for name, up in _verticals(ecef).items()}
    best, other = sorted(tilt, key=lambda name: tilt[name])
    return best if tilt[best] < _LEVEL_SINE and tilt[other] > _LEVEL_SINE else None


def _verticals(ecef: ShiftedEcef) -> dict[str, NDArray[np.float64]]:
    """Returns the direction of up in each frame."""
    return {
        ENU: np.array([0.0, 0.0, 1.0]),
        SHIFTED_ECEF: enu_from_ecef_rotation(ecef.lat_deg, ecef.lon_deg)[2],
    }
