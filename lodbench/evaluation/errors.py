"""Translation and rotation error of a pose."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lodbench.geometry import Pose, wrap_deg


class PoseError(NamedTuple):
    """Distance of the camera centres in metres, and angle of the turn between the poses in degrees."""

    translation_m: float
    rotation_deg: float


class ErrorParts(NamedTuple):
    """The same error taken apart: along the ground, up (+ is too high), in yaw (+ is too far left)."""

    horizontal_m: float
    vertical_m: float
    yaw_deg: float


# What a query without an answer counts as.
FAILED = PoseError(math.inf, 180.0)
FAILED_PARTS = ErrorParts(math.inf, math.inf, 180.0)


def pose_error(estimate: Pose, truth: Pose) -> PoseError:
    """Returns the errors of an estimate.

    The angle comes from atan2 of the turn's sine and cosine: unlike arccos of the trace it keeps
    its digits near 0.
    """
    turn = truth.rotation.T @ estimate.rotation
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    angle = math.atan2(float(np.linalg.norm(axis)), float(np.trace(turn)) - 1.0)
    return PoseError(float(np.linalg.norm(estimate.center - truth.center)), math.degrees(angle))


def error_parts(estimate: Pose, truth: Pose) -> ErrorParts:
    """Returns an estimate's error along the ground, upwards and in yaw; the frame's z points up."""
    x, y, z = estimate.center - truth.center
    return ErrorParts(math.hypot(x, y), float(z), wrap_deg(estimate.euler.yaw_deg - truth.euler.yaw_deg))
