"""A pose as six numbers, and how its rotation changes with them.

The six numbers are the camera's centre (x, y, z; scene metres) and the datasets' angles (pitch,
roll, yaw; degrees). What sensors are wrong about is independent in these, so a prior is a diagonal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.angles import rotation_from_euler

Floats = NDArray[np.float64]

_DEG = np.pi / 180.0
# Turning about an axis by an angle more is multiplying by this per radian, on the angle's own side.
_CROSS_X = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_CROSS_Z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def vector_from_pose(pose: Pose) -> Floats:
    """Returns (6,): centre in metres, then pitch, roll and yaw in degrees."""
    return np.array([*pose.center, *pose.euler])


def pose_from_vector(vector: Floats) -> Pose:
    """Returns the pose of (6,) centre in metres and angles in degrees."""
    return Pose.from_euler(EulerAngles(*(float(v) for v in vector[3:6])), vector[:3])


def rotation_derivatives(vector: Floats) -> Floats:
    """Returns (3, 3, 3): the change of cam_from_world per degree of pitch, roll and yaw.

    The rotation is ``F Rx(pitch)^T Ry(roll)^T Rz(yaw)^T`` with F the flip to OpenCV axes. Pitch is its
    innermost turn and yaw its outermost, so each derivative is the rotation times a cross product; roll
    turns about the world's y axis after yaw.
    """
    rotation = rotation_from_euler(EulerAngles(*(float(v) for v in vector[3:6])))
    yaw = float(vector[5]) * _DEG
    level_y = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    # Both flips of the cross product cancel, and a turn commutes with its own cross product.
    about_pitch = -_CROSS_X @ rotation
    about_roll = -rotation @ cross_matrix(level_y)
    about_yaw = -rotation @ _CROSS_Z
    return np.ascontiguousarray(np.stack([about_pitch, about_roll, about_yaw]) * _DEG)


def turn_per_angle(vector: Floats) -> Floats:
    """Returns (3, 3): columns are the rotation vectors, degrees per degree, of pitch, roll and yaw.

    The length of this matrix times three small angle errors is the rotation error of evaluation.
    """
    rotation = rotation_from_euler(EulerAngles(*(float(v) for v in vector[3:6])))
    columns = []
    for derivative in rotation_derivatives(vector):
        skew = derivative @ rotation.T / _DEG
        columns.append([skew[2, 1], skew[0, 2], skew[1, 0]])
    return np.array(columns).T


def cross_matrix(axis: Floats) -> Floats:
    """Returns (3, 3) the matrix by which an axis, (3,), is multiplied with vectors in the cross product."""
    x, y, z = (float(v) for v in axis)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
