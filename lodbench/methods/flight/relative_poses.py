"""What ties photos to each other: relative poses of pairs, and a reconstruction of the flight.

A pair has a turn, and a direction from one photo to the other. A reconstruction (COLMAP and the like) has the
poses of all, right up to a similarity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.geometry import Pose
from lodbench.geometry.pose import cross_matrix, pose_from_vector

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


# What is unknown of a reconstruction: a shift (metres), a turn (radians, map axes), the logarithm of its
# scale; and a turn of all its cameras about their own axes (radians): a focal length or a principal point
# that it has wrong tips all photos alike, and leaves their places and pixels as they are.
UNKNOWNS, MOUNT = 10, slice(7, 10)
# Fewer photos than this leave a similarity open.
FEWEST_PHOTOS = 3
# Photos this much further from their priors than half of them do not place it.
_OUTLIER = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """Poses of photos in the map, right up to a similarity.

    Attributes:
        poses: By number of the photo.
        middle: (3,) what the similarity turns and scales about, metres.
        information: (6, 6) of each photo's centre (metres) and turn (radians, camera axes).
        mount: (3,) by how much its cameras are turned about their axes already, radians.
    """

    poses: Mapping[int, Pose]
    middle: Floats
    information: Floats
    mount: Floats = field(default_factory=lambda: np.zeros(3))

    @property
    def photos(self) -> Sequence[int]:
        """Returns the numbers of its photos."""
        return list(self.poses)

    def part(self, numbers: Mapping[int, int], vectors: Floats) -> Reconstruction | None:
        """Returns it of some photos, by new numbers, at their poses, (P, 6); None of too few of them."""
        poses = {numbers[photo]: pose for photo, pose in self.poses.items() if photo in numbers}
        found = placed(poses, vectors, self.information)
        return None if found is None else replace(found, mount=self.mount)

    def moved(self, step: Floats) -> Reconstruction:
        """Returns it after a step of its (10,) unknowns. Eq. (F10) of docs/methods/flight.md."""
        turn, tip = (
            scipy.spatial.transform.Rotation.from_rotvec(step[part]).as_matrix()
            for part in (slice(3, 6), MOUNT)
        )
        scale = float(np.exp(step[6]))
        poses = {
            photo: Pose.from_center(
                tip @ pose.rotation @ turn.T,
                self.middle + step[:3] + scale * turn @ (pose.center - self.middle),
            )
            for photo, pose in self.poses.items()
        }
        return Reconstruction(poses, self.middle + step[:3], self.information, self.mount + step[MOUNT])

    def linearize(self, photo: int, vectors: Floats, derivatives: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Returns (6,) how far a photo's pose is from its own, and (6, 16) the change per unit of both.

        Eq. (F10) of docs/methods/flight.md.

        Args:
            photo: Its number.
            vectors: (P, 6) poses of all photos, metres and degrees.
            derivatives: Of each, from ``rotation_derivatives``.
        """
        mine, here = self.poses[photo], pose_from_vector(vectors[photo])
        away = mine.center - self.middle
        turn = here.rotation @ mine.rotation.T
        residuals = np.concatenate([here.center - mine.center, rotation_vector(turn)])
        jacobian = np.zeros((6, 6 + UNKNOWNS))
        jacobian[:3, :3], jacobian[:3, 6:9] = np.eye(3), -np.eye(3)
        jacobian[:3, 9:12], jacobian[:3, 12] = cross_matrix(away), -away
        for angle in range(3):
            skew = derivatives[photo][angle] @ here.rotation.T
            jacobian[3:, 3 + angle] = skew[2, 1], skew[0, 2], skew[1, 0]
        jacobian[3:, 9:12] = here.rotation
        jacobian[3:, 13:16] = -np.eye(3)
        return residuals, jacobian

    def weighted_information(self, residuals: Floats, scales: Sequence[float]) -> Floats:
        """Returns (6, 6) the information, less for a photo far off; places and turns err by shares (2,)."""
        told = np.repeat(scales, 3)
        return robust(self.information / np.outer(told, told), residuals)


def placed(poses: Mapping[int, Pose], vectors: Floats, information: Floats) -> Reconstruction | None:
    """Returns a reconstruction moved to where photos are thought to be; None if it has too few of them.

    The turn is the mean of what each photo says, so that a straight flight leaves none open.

    Args:
        poses: In the reconstruction's frame, by number of the photo.
        vectors: (P, 6) where photos are thought to be, metres and degrees.
        information: (6, 6) of each pose within it; see ``Reconstruction``.
    """
    if len(poses) < FEWEST_PHOTOS:
        return None
    photos = sorted(poses)
    thought = [pose_from_vector(vectors[photo]) for photo in photos]
    turns = [here.rotation.T @ poses[photo].rotation for photo, here in zip(photos, thought, strict=True)]
    turn = scipy.spatial.transform.Rotation.from_matrix(np.array(turns)).mean().as_matrix()
    there = np.array([turn @ poses[photo].center for photo in photos])
    here = np.array([pose.center for pose in thought])
    kept = np.ones(len(photos), dtype=bool)
    scale, shift = 1.0, np.zeros(3)
    for _ in range(3):
        one, other = there[kept], here[kept]
        spread = one - one.mean(axis=0)
        scale = float((spread * (other - other.mean(axis=0))).sum() / max((spread**2).sum(), 1e-12))
        shift = other.mean(axis=0) - scale * one.mean(axis=0)
        away = np.linalg.norm(scale * there + shift - here, axis=1)
        kept = away <= _OUTLIER * np.median(away)
    if scale <= 0:
        return None
    moved = {
        photo: Pose.from_center(poses[photo].rotation @ turn.T, scale * there[k] + shift)
        for k, photo in enumerate(photos)
    }
    return Reconstruction(moved, here[kept].mean(axis=0), information)
