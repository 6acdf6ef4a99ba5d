"""Translation and rotation error of a pose."""

from __future__ import annotations

import math
from typing import NamedTuple

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


class Apart(NamedTuple):
    """How far one answer to a query lies from another, as ``pose_error`` and ``error_parts`` measure errors.

    Attributes:
        error: Distance of the camera centres, metres, and angle of the turn between the poses, degrees.
        parts: The same taken apart: along the ground, how much higher (metres) and further left (degrees)
            the second is than the first.
    """

    error: PoseError
    parts: ErrorParts


# What a query without an answer counts as.
FAILED = PoseError(math.inf, 180.0)
FAILED_PARTS = ErrorParts(math.inf, math.inf, 180.0)


def pose_error(estimate: Pose, truth: Pose) -> PoseError:
    """Returns the errors of an estimate.

    The angle comes from atan2 of the turn's sine and cosine: unlike arccos of the trace it keeps
    its digits near 0.

    Example:
        >>> from lodbench.geometry import EulerAngles
        >>> truth = Pose.from_euler(EulerAngles(30, 0, 45), center=(0, 0, 100))
        >>> error = pose_error(Pose.from_euler(EulerAngles(30, 0, 47), center=(3, 4, 100)), truth)
        >>> round(error.translation_m, 6), round(error.rotation_deg, 6)
        (5.0, 2.0)
    """
    # Nine numbers are quicker as floats than as arrays, and evaluating means millions of poses.
    turn = (truth.rotation.T @ estimate.rotation).tolist()
    sine = math.hypot(turn[2][1] - turn[1][2], turn[0][2] - turn[2][0], turn[1][0] - turn[0][1])
    angle = math.atan2(sine, turn[0][0] + turn[1][1] + turn[2][2] - 1.0)
    distance_m = math.dist(estimate.center.tolist(), truth.center.tolist())
    return PoseError(distance_m, math.degrees(angle))


def apart(second: Pose, first: Pose) -> Apart:
    """Returns how far a second answer lies from a first."""
    return Apart(pose_error(second, first), error_parts(second, first))


def error_parts(estimate: Pose, truth: Pose) -> ErrorParts:
    """Returns an estimate's error along the ground, upwards and in yaw; the frame's z points up."""
    x, y, z = estimate.center - truth.center
    return ErrorParts(math.hypot(x, y), float(z), wrap_deg(estimate.euler.yaw_deg - truth.euler.yaw_deg))
