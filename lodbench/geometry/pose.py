"""Camera poses: world to camera, OpenCV axes (x right, y down, z forward), metres."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import LodbenchError
from lodbench.geometry.angles import EulerAngles, euler_from_rotation, rotation_from_euler

Matrix = NDArray[np.float64]

# A quaternion further than this from unit length is a wrong number, not rounding.
UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Pose:
    """A camera pose: ``x_cam = rotation @ x_world + translation``.

    Made as it stands, as searches make many; ``from_center`` and its like look at what they are given.

    Attributes:
        rotation: (3, 3) float64 cam_from_world rotation, determinant +1.
        translation: (3,) float64, metres.

    Example:
        >>> down = Pose.from_euler(EulerAngles(pitch_deg=0, roll_deg=0, yaw_deg=0), center=(10, 20, 100))
        >>> down.center.tolist()
        [10.0, 20.0, 100.0]
        >>> (down.cam_from_world @ [10, 20, 0, 1]).tolist()  # the ground below lies 100 m ahead
        [0.0, 0.0, 100.0, 1.0]
    """

    rotation: Matrix
    translation: Matrix

    def __repr__(self) -> str:
        x, y, z = (float(value) for value in self.center)
        pitch, roll, yaw = self.euler
        return (
            f"Pose(center=({x:.2f}, {y:.2f}, {z:.2f}), pitch={pitch:.2f}, roll={roll:.2f}, yaw={yaw:.2f} deg)"
        )

    @property
    def cam_from_world(self) -> Matrix:
        """Returns the (4, 4) world-to-camera matrix."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return matrix

    @property
    def world_from_cam(self) -> Matrix:
        """Returns the (4, 4) camera-to-world matrix."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation.T, self.center
        return matrix

    @property
    def center(self) -> Matrix:
        """Returns the camera centre, (3,), world metres: ``-R.T @ t``."""
        return np.asarray(-self.rotation.T @ self.translation)

    @property
    def euler(self) -> EulerAngles:
        """Returns pitch, roll and yaw in degrees (the datasets' convention)."""
        return euler_from_rotation(self.rotation)

    @property
    def quat_wxyz(self) -> tuple[float, float, float, float]:
        """Returns the unit quaternion (w, x, y, z) of the rotation, w >= 0."""
        return quaternion_from_rotation(self.rotation)

    @classmethod
    def from_center(cls, rotation: Matrix, center: Sequence[float] | Matrix) -> Pose:
        """Returns the pose of a camera at a world position with a cam_from_world rotation.

        Raises:
            LodbenchError: The rotation is not orthonormal with determinant +1, or the place no three numbers.
        """
        rotation = np.array(rotation, dtype=np.float64)
        _require_rotation(rotation)
        return cls(rotation, -rotation @ _three("center", center))

    @classmethod
    def from_euler(cls, angles: EulerAngles, center: Sequence[float] | Matrix) -> Pose:
        """Returns the pose of a camera at a world position with pitch, roll and yaw in degrees.

        Raises:
            LodbenchError: An angle is not finite, or the place no three numbers.
        """
        if not all(map(math.isfinite, angles)):
            raise LodbenchError("A pitch, roll or yaw is not finite.")
        rotation = rotation_from_euler(angles)
        return cls(rotation, -rotation @ _three("center", center))

    @classmethod
    def from_matrix(cls, cam_from_world: Matrix) -> Pose:
        """Returns the pose of a (4, 4) or (3, 4) world-to-camera matrix.

        Raises:
            LodbenchError: The matrix is of another shape or not finite, or its rotation is not orthonormal
                with determinant +1.
        """
        matrix = np.asarray(cam_from_world, dtype=np.float64)
        if matrix.shape not in ((4, 4), (3, 4)):
            raise LodbenchError(
                f"A pose matrix is (4, 4) or (3, 4), not {matrix.shape}.",
                "Pose.from_center takes a rotation and a place.",
            )
        rotation = np.array(matrix[:3, :3])
        if not np.isfinite(matrix).all():
            raise LodbenchError("A pose matrix has values that are not finite.")
        _require_rotation(rotation)
        return cls(rotation, np.array(matrix[:3, 3]))

    @classmethod
    def from_quaternion(cls, quat_wxyz: Sequence[float], translation: Sequence[float]) -> Pose:
        """Returns the pose of a quaternion (w, x, y, z) and a translation, world to camera.

        Raises:
            LodbenchError: A value is not finite, or the quaternion is not of unit length.
        """
        offset = np.array(translation, dtype=np.float64)
        if not np.isfinite(offset).all():
            raise LodbenchError("A value of a translation is not finite.")
        return cls(rotation_from_quaternion(quat_wxyz), offset)

    def shifted(self, offset_m: Sequence[float] | Matrix) -> Pose:
        """Returns the pose with its centre moved by (3,) world metres.

        Raises:
            LodbenchError: The offset is no three numbers.
        """
        return Pose(self.rotation, self.translation - self.rotation @ _three("offset_m", offset_m))

    def with_tilt_of(self, other: Pose) -> Pose:
        """Returns this pose with the pitch and roll of another; yaw and centre stay."""
        tilt = other.euler
        angles = EulerAngles(tilt.pitch_deg, tilt.roll_deg, self.euler.yaw_deg)
        return Pose.from_euler(angles, self.center)


def _three(name: str, values: Sequence[float] | Matrix) -> Matrix:
    """Returns a place or an offset as (3,) float64."""
    found = np.asarray(values, dtype=np.float64)
    if found.shape != (3,):
        raise LodbenchError(f"{name} holds east, north and up: (3,), not {found.shape}.")
    return found


def _require_rotation(rotation: Matrix) -> None:
    if rotation.shape != (3, 3):
        raise LodbenchError(f"A rotation is (3, 3), not {rotation.shape}.")
    # The other way round NaN would pass.
    is_orthonormal = np.abs(rotation @ rotation.T - np.eye(3)).max() <= UNIT_TOLERANCE
    if not is_orthonormal or np.linalg.det(rotation) < 0:
        raise LodbenchError(
            "A pose matrix holds no rotation (orthonormal, determinant +1).",
            "Check the row order and whether axes were mirrored.",
        )


def rotation_from_quaternion(quat_wxyz: Sequence[float]) -> Matrix:
    """Returns the (3, 3) rotation of a quaternion (w, x, y, z), normalised first.

    Raises:
        LodbenchError: A value is not finite, or the length differs from 1 by more than 1e-3.
    """
    norm = math.sqrt(sum(float(v) * float(v) for v in quat_wxyz))
    if not math.isfinite(norm):
        raise LodbenchError("A value of a quaternion is not finite.")
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        raise LodbenchError(f"A quaternion has length {norm:.6g} instead of 1.", "The order is qw qx qy qz.")
    w, x, y, z = (float(v) / norm for v in quat_wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: Matrix) -> tuple[float, float, float, float]:
    """Returns the unit quaternion (w, x, y, z), w >= 0, of a (3, 3) rotation (Shepperd's method)."""
    r = np.asarray(rotation, dtype=np.float64)
    # Four times each squared component; starting from the largest keeps every division safe.
    squares = 1.0 + np.array(
        [
            r[0, 0] + r[1, 1] + r[2, 2],
            r[0, 0] - r[1, 1] - r[2, 2],
            r[1, 1] - r[0, 0] - r[2, 2],
            r[2, 2] - r[0, 0] - r[1, 1],
        ]
    )
    wx, wy, wz = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    largest = int(np.argmax(squares))
    row = [
        [squares[0], wx, wy, wz],
        [wx, squares[1], xy, xz],
        [wy, xy, squares[2], yz],
        [wz, xz, yz, squares[3]],
    ][largest]
    norm = math.copysign(math.sqrt(sum(float(v) ** 2 for v in row)), float(row[0]))
    w, x, y, z = (float(v) / norm for v in row)
    return w, x, y, z
