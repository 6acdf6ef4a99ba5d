"""Poses, cameras, angles and frames: the one place where conventions live."""

from lodbench.geometry.angles import (
    EulerAngles,
    euler_from_rotation,
    rotation_from_euler,
    rotations_at_yaws,
    wrap_deg,
)
from lodbench.geometry.camera import Camera, CameraSigmas
from lodbench.geometry.pose import AxisRange, Pose, PoseGrid

__all__ = [
    "AxisRange",
    "Camera",
    "CameraSigmas",
    "EulerAngles",
    "Pose",
    "PoseGrid",
    "euler_from_rotation",
    "rotation_from_euler",
    "rotations_at_yaws",
    "wrap_deg",
]
