"""Camera poses (world to camera, OpenCV axes, metres), as six numbers, and grids of them around a prior.

As six numbers: the camera's centre (x, y, z; scene metres) and the datasets' angles (pitch, roll, yaw;
degrees). What sensors are wrong about is independent in these, so a prior is a diagonal.
``PoseGrid`` is the 4D grid of hypotheses of LoD-Loc v2 (paper equation 1).
"""

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
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape != (3,):
        raise LodbenchError(f"{name} holds east, north and up: (3,), not {vector.shape}.")
    return vector


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


@dataclass(frozen=True, slots=True)
class AxisRange:
    """One axis of the grid: full width (metres or degrees) and number of samples."""

    width: float
    count: int

    def __post_init__(self) -> None:
        if self.count < 1 or not 0 <= self.width < math.inf:
            raise LodbenchError(
                f"A grid axis needs a width >= 0 and a count >= 1, not {self.width} and {self.count}."
            )

    def offsets(self) -> NDArray[np.float64]:
        """Returns ``count`` offsets from -width/2 to +width/2, ends included; one sample is the centre.

        Eq. (L1) of docs/methods/lodlocv2.md.
        """
        if self.count == 1:
            return np.zeros(1)
        steps = np.arange(self.count, dtype=np.float64)
        return -self.width / 2 + steps * (self.width / (self.count - 1))


@dataclass(frozen=True, slots=True)
class PoseGrid:
    """The Cartesian product of four axes, in the order (yaw, x, y, z), z fastest."""

    x: AxisRange
    y: AxisRange
    z: AxisRange
    yaw: AxisRange

    def __len__(self) -> int:
        return self.x.count * self.y.count * self.z.count * self.yaw.count

    def around(self, prior: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the hypotheses around a prior; pitch and roll stay the prior's.

        Returns:
            Camera centres, (N, 3), world metres, and yaws, (N,), degrees.
        """
        yaws = prior.euler.yaw_deg + self.yaw.offsets()
        axes = np.meshgrid(self.x.offsets(), self.y.offsets(), self.z.offsets(), indexing="ij")
        centers = prior.center + np.stack([axis.ravel() for axis in axes], axis=1)
        return np.tile(centers, (self.yaw.count, 1)), np.repeat(yaws, len(centers))
