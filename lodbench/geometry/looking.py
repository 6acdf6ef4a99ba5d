"""Where a camera looks, in the terms of people and gimbals: heading, pitch and roll.

The heading is of the optical axis's level direction, clockwise from north; the pitch is of that axis above
the horizon; the roll turns about it, 0 where rows of the picture are level, positive where the right side
dips. These are DJI's gimbal angles (``rotation_from_dji``): drones state them, ``--heading`` takes them back.

Closer to straight down, or up, than ``STEEP_DEG`` the axis has hardly a direction on the map: the smallest
tilt would turn heading and roll by any angle. There the heading is of the picture's top (looking down), and
pitch and roll say by how much the axis leans ahead and aside, as ``EulerAngles`` do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry.angles import (
    EulerAngles,
    dji_from_rotation,
    euler_from_rotation,
    heading_from_yaw,
    rotation_from_dji,
    rotation_from_euler,
    turning_axes,
    wrap_deg,
)

Matrix = NDArray[np.float64]

# Twice what gimbals are off by.
STEEP_DEG = 2.0


class LookAngles(NamedTuple):
    """Where a camera looks, degrees.

    Attributes:
        heading_deg: Of the optical axis on the map, clockwise from north, in [0, 360).
        pitch_deg: Of the optical axis above the horizon: 0 level, -90 straight down.
        roll_deg: About the optical axis, in [-180, 180]; positive where the right side of the picture dips.

    Closer to straight down than ``STEEP_DEG`` the heading is of the picture's top; the pitch is below -90
    where the axis leans to the picture's bottom; the roll is by how much the picture's right side dips.
    """

    heading_deg: float
    pitch_deg: float
    roll_deg: float


def off_nadir_deg(cam_from_world: Matrix) -> float:
    """Returns the angle from straight down to the optical axis of a (3, 3) rotation, 0 to 180 degrees."""
    east, north, up = cam_from_world[2]
    return math.degrees(math.atan2(math.hypot(east, north), -up))


def look_from_rotation(cam_from_world: Matrix, convergence_deg: float = 0.0) -> LookAngles:
    """Returns where a camera with a (3, 3) cam_from_world rotation looks.

    Args:
        cam_from_world: The rotation; its world is east, north, up.
        convergence_deg: Clockwise angle from true to grid north, for a heading from true north; 0 for one
            from the grid's.
    """
    if _is_steep(cam_from_world):
        pitch, roll, yaw = euler_from_rotation(cam_from_world)
        return LookAngles(heading_from_yaw(yaw - convergence_deg), wrap_deg(pitch - 90.0), roll)
    yaw, pitch, roll = dji_from_rotation(cam_from_world, convergence_deg)
    return LookAngles(heading_from_yaw(-yaw), pitch, roll)


def rotation_from_look(heading_deg: float, pitch_deg: float, roll_deg: float) -> Matrix:
    """Returns cam_from_world, (3, 3), of ``LookAngles``: the inverse of ``look_from_rotation``."""
    steep = rotation_from_euler(EulerAngles(pitch_deg + 90.0, roll_deg, -heading_deg))
    return steep if _is_steep(steep) else rotation_from_dji(heading_deg, pitch_deg, roll_deg)


def look_covariance(cam_from_world: Matrix, euler_covariance: Matrix) -> Matrix:
    """Returns the (3, 3) covariance of heading, pitch and roll, degrees squared, to first order.

    Args:
        cam_from_world: (3, 3) rotation.
        euler_covariance: (3, 3) of the error in the pitch, roll and yaw of ``EulerAngles``, degrees squared.
    """
    if _is_steep(cam_from_world):
        # Of pitch, roll and yaw; a heading counts the other way than yaw.
        slopes = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    else:
        ahead = cam_from_world[2]
        right = np.array([ahead[1], -ahead[0], 0.0]) / math.hypot(ahead[0], ahead[1])
        # World axes about which a degree more of heading, pitch and roll turns the camera, in columns.
        own = np.column_stack([[0.0, 0.0, -1.0], right, ahead])
        slopes = np.linalg.solve(own, turning_axes(euler_from_rotation(cam_from_world)).T)
    return np.asarray(slopes @ euler_covariance @ slopes.T)


def _is_steep(cam_from_world: Matrix) -> bool:
    return math.hypot(cam_from_world[2, 0], cam_from_world[2, 1]) < math.sin(math.radians(STEEP_DEG))
