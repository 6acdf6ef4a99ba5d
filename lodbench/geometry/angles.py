"""Angle conventions: the datasets' (pitch, roll, yaw), and those of DJI and Blender.

The datasets' convention. Let ``R`` turn Blender camera axes (x right, y up, looking along -z) into
the world (x east, y north, z up). Then ``R = Rz(yaw) Ry(roll) Rx(pitch)``: pitch 0 looks straight
down, 90 at the horizon; yaw is counter-clockwise from grid north. OpenCV camera axes (x right,
y down, z forward) are Blender's with y and z negated.

Where a camera looks, in the terms of people and gimbals (``LookAngles``): the heading is of the axis's
level direction, clockwise from north; the pitch is of that axis above the horizon; the roll turns about it, 0
where rows of the picture are level, positive where the right side dips. These are DJI's gimbal angles
(``rotation_from_dji``): drones state them, ``--heading`` takes them back.

Closer to straight down, or up, than ``STEEP_DEG`` the axis has hardly a direction on the map: the smallest
tilt would turn heading and roll by any angle. There the heading is of the picture's top (looking down), and
pitch and roll say by how much the axis leans ahead and aside, as ``EulerAngles`` do.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Degrees = TypeVar("Degrees", float, NDArray[np.float64])

# Blender camera axes from OpenCV camera axes, and back: the same flip both ways.
_FLIP_YZ = np.diag([1.0, -1.0, -1.0])
# OpenCV camera axes (right, down, forward) in a body frame of (forward, right, down).
_BODY_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
# East-north-up from north-east-down.
_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# A sine of a gimbal's pitch this near to 1 is straight down, or up.
_STEEP = 1.0 - 1e-12


class EulerAngles(NamedTuple):
    """Camera attitude in degrees: pitch from nadir, roll, yaw counter-clockwise from grid north.

    Pitch turns about the picture's right side, roll about the level axis ahead, then yaw about the vertical.
    So the right side dips by roll and points yaw from east; where roll is 0, the view goes yaw from north.
    """

    pitch_deg: float
    roll_deg: float
    yaw_deg: float


def wrap_deg(angle_deg: Degrees) -> Degrees:
    """Returns the same direction, or directions, in [-180, 180) degrees; NaN stays NaN."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def _axis_rotation(axis: int, angle_deg: float) -> Matrix:
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    rotation[i, i], rotation[i, j], rotation[j, i], rotation[j, j] = c, -s, s, c
    return rotation


def _rz_ry_rx(pitch_deg: float, roll_deg: float, yaw_deg: float) -> Matrix:
    return _axis_rotation(2, yaw_deg) @ _axis_rotation(1, roll_deg) @ _axis_rotation(0, pitch_deg)


def _angles_of(rotation: Matrix) -> EulerAngles:
    sin_roll = min(1.0, max(-1.0, -float(rotation[2, 0])))
    return EulerAngles(
        math.degrees(math.atan2(rotation[2, 1], rotation[2, 2])),
        math.degrees(math.asin(sin_roll)),
        math.degrees(math.atan2(rotation[1, 0], rotation[0, 0])),
    )


def rotation_from_euler(angles: EulerAngles) -> Matrix:
    """Returns cam_from_world, (3, 3), of a camera with the datasets' angles in degrees.

    Eq. (M1) of docs/methods/index.md.
    """
    world_from_cam = _rz_ry_rx(*angles) @ _FLIP_YZ
    return np.ascontiguousarray(world_from_cam.T)


def rotations_from_euler(angles_deg: Matrix) -> Matrix:
    """Returns (N, 3, 3) cam_from_world of (N, 3) pitch, roll and yaw, degrees.

    Written out element by element: no matrix product, whose last bit may depend on the BLAS.
    """
    (cp, cr, cy), (sp, sr, sy) = (turn(np.radians(angles_deg).T) for turn in (np.cos, np.sin))
    rows = [
        [cy * cr, sy * cr, -sr],
        [sy * cp - cy * sr * sp, -cy * cp - sy * sr * sp, -cr * sp],
        [-cy * sr * cp - sy * sp, cy * sp - sy * sr * cp, -cr * cp],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), 2, 0))


def rotations_at_yaws(pitch_deg: float, roll_deg: float, yaws_deg: Matrix) -> Matrix:
    """Returns (N, 3, 3) cam_from_world rotations of one tilt at (N,) yaws, degrees.

    Written out element by element: no matrix product, whose last bit may depend on the BLAS.
    """
    level = (_rz_ry_rx(pitch_deg, roll_deg, 0.0) @ _FLIP_YZ).T
    yaws = np.radians(np.asarray(yaws_deg, dtype=np.float64))
    c, s = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    x, y = level[:, 0], level[:, 1]
    z = np.broadcast_to(level[:, 2], (len(yaws), 3))
    return np.ascontiguousarray(np.stack([c * x - s * y, s * x + c * y, z], axis=2))


def euler_from_rotation(cam_from_world: Matrix) -> EulerAngles:
    """Returns the datasets' angles in degrees of a (3, 3) cam_from_world rotation.

    Yaw and roll are well defined at nadir; they trade off only at roll = +-90 degrees.
    """
    return _angles_of(cam_from_world.T @ _FLIP_YZ)


def turning_axes(angles: EulerAngles) -> Matrix:
    """Returns the world axes about which more pitch, roll and yaw turn a camera, (3, 3), one a row.

    A direction in the world that is fixed to the camera changes by ``cross(axis, direction)`` a radian.
    """
    about_up = _axis_rotation(2, angles.yaw_deg)
    return np.array([(about_up @ _axis_rotation(1, angles.roll_deg))[:, 0], about_up[:, 1], [0.0, 0.0, 1.0]])


def rotation_from_dji(
    gimbal_yaw_deg: float, gimbal_pitch_deg: float, gimbal_roll_deg: float, convergence_deg: float = 0.0
) -> Matrix:
    """Returns cam_from_world, (3, 3), of a DJI gimbal's angles.

    The gimbal turns by yaw (clockwise from true north), then pitch (0 at the horizon, -90 at nadir),
    then roll about the optical axis, in a north-east-down frame.

    Args:
        gimbal_yaw_deg: GimbalYawDegree.
        gimbal_pitch_deg: GimbalPitchDegree.
        gimbal_roll_deg: GimbalRollDegree.
        convergence_deg: Grid convergence, clockwise angle from true to grid north: grid heading is
            true heading minus this.
    """
    ned_from_body = _rz_ry_rx(gimbal_roll_deg, gimbal_pitch_deg, gimbal_yaw_deg - convergence_deg)
    world_from_cam = _ENU_FROM_NED @ ned_from_body @ _BODY_FROM_CAMERA
    return np.ascontiguousarray(world_from_cam.T)


def dji_from_rotation(cam_from_world: Matrix, convergence_deg: float = 0.0) -> tuple[float, float, float]:
    """Returns a DJI gimbal's yaw, pitch and roll, degrees, of a (3, 3) cam_from_world rotation.

    The inverse of ``rotation_from_dji``; straight down, where yaw and roll trade off, roll is 0.

    Args:
        cam_from_world: The rotation.
        convergence_deg: As there.
    """
    ned_from_body = _ENU_FROM_NED.T @ cam_from_world.T @ _BODY_FROM_CAMERA.T
    x, _, z = ned_from_body[:, 0]
    pitch = math.degrees(math.atan2(-z, math.hypot(x, ned_from_body[1, 0])))
    if abs(z) > _STEEP:
        yaw = math.degrees(math.atan2(-ned_from_body[0, 1], ned_from_body[1, 1]))
        return wrap_deg(yaw + convergence_deg), pitch, 0.0
    yaw = math.degrees(math.atan2(ned_from_body[1, 0], x))
    roll = math.degrees(math.atan2(ned_from_body[2, 1], ned_from_body[2, 2]))
    return wrap_deg(yaw + convergence_deg), pitch, roll


def blender_from_opencv(world_from_cam: Matrix) -> Matrix:
    """Returns a (4, 4) camera-to-world matrix with Blender axes from one with OpenCV axes.

    The map is its own inverse, so it also turns Blender's into OpenCV's.
    """
    flip = np.eye(4)
    flip[:3, :3] = _FLIP_YZ
    return np.asarray(world_from_cam @ flip)


def heading_from_yaw(yaw_deg: float) -> float:
    """Returns the compass heading in [0, 360), clockwise from grid north, of a yaw in degrees."""
    return (-yaw_deg) % 360.0


# Twice what gimbals are off by.
STEEP_DEG = 2.0


class LookAngles(NamedTuple):
    """Where a camera looks, degrees.

    Closer to straight down than ``STEEP_DEG`` the heading is of the picture's top; the pitch is below -90
    where the axis leans to the picture's bottom; the roll is by how much the picture's right side dips.
    """

    heading_deg: float  # of the optical axis on the map, clockwise from north, in [0, 360)
    pitch_deg: float  # of the optical axis above the horizon: 0 level, -90 straight down
    # About the optical axis, in [-180, 180]; positive where the right side of the picture dips
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
