"""What a pair of photos says of their relative pose: a turn, and the direction from one to the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.geometry.pose_vector import pose_from_vector

Floats = NDArray[np.float64]

# Pairs further off than so many sigmas count less and less (Cauchy's kernel).
_OUTLIER_SIGMAS = 3.0
# Photos nearer to each other than this have no direction between them, metres.
_NEAREST_M = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """A point ``x`` of the first photo's camera is ``rotation @ x + s direction`` in the second's, s unknown.

    Attributes:
        first: Number of the first photo.
        second: Of the second.
        rotation: (3, 3) second_from_first.
        direction: (3,) unit, towards the first photo's centre in the second's camera.
        information: (5, 5) of the turn (radians, second camera's axes) and the direction (``tangents``).
        per_focal: (5,) by how much both change per share that the focal length is longer than told.
    """

    first: int
    second: int
    rotation: Floats
    direction: Floats
    information: Floats
    per_focal: Floats

    def linearize(
        self, vectors: Floats, derivatives: Sequence[Floats], focal: float
    ) -> tuple[Floats, Floats]:
        """Returns (5,) how far two poses are from it, and (5, 13) the change per unit of them and the focal.

        Eq. (F8) of docs/methods/flight.md.

        Args:
            vectors: (P, 6) poses of all photos, metres and degrees.
            derivatives: Of each, from ``rotation_derivatives``.
            focal: By which share the focal length is longer than told.
        """
        here, there = (pose_from_vector(vectors[k]) for k in (self.first, self.second))
        baseline = here.center - there.center
        length = max(float(np.linalg.norm(baseline)), _NEAREST_M)
        seen = there.rotation @ baseline / length
        across = tangents(self.direction)
        turn = there.rotation @ here.rotation.T
        residuals = np.concatenate([rotation_vector(turn @ self.rotation.T), across @ seen])
        jacobian = np.zeros((5, 13))
        per_metre = across @ (np.eye(3) - np.outer(seen, seen)) @ there.rotation / length
        jacobian[3:, :3], jacobian[3:, 6:9] = per_metre, -per_metre
        for angle in range(3):
            of_first = there.rotation @ derivatives[self.first][angle].T
            of_second = derivatives[self.second][angle] @ here.rotation.T
            jacobian[:3, 3 + angle] = _axial(of_first @ turn.T)
            jacobian[:3, 9 + angle] = _axial(of_second @ turn.T)
            jacobian[3:, 9 + angle] = across @ (derivatives[self.second][angle] @ baseline) / length
        jacobian[:, 12] = -self.per_focal
        return residuals - self.per_focal * focal, jacobian

    def weighted_information(self, residuals: Floats, scale: float = 1.0) -> Floats:
        """Returns (5, 5) the information, less for a pair far off; errors are a share of those told."""
        return robust(self.information / scale**2, residuals)


def robust(information: Floats, residuals: Floats) -> Floats:
    """Returns an information matrix scaled by Cauchy's weight of its residuals.

    Eq. (F11) of docs/methods/flight.md.
    """
    square = float(residuals @ information @ residuals) / len(residuals)
    return information / (1.0 + square / _OUTLIER_SIGMAS**2)


def tangents(direction: Floats) -> Floats:
    """Returns (2, 3) unit vectors across a unit direction and each other."""
    least = np.eye(3)[int(np.argmin(np.abs(direction)))]
    one = np.cross(direction, least)
    one /= np.linalg.norm(one)
    return np.stack([one, np.cross(direction, one)])


def rotation_vector(rotation: Floats) -> Floats:
    """Returns (3,) radians about the axes."""
    return np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64).ravel()


def _axial(skew: Floats) -> Floats:
    return 0.5 * np.array([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]])
