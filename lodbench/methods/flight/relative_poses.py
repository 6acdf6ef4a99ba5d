"""What ties photos to each other: relative poses of pairs by features, and a reconstruction of the flight.

A pair has a turn, and a direction from one photo to the other. A reconstruction (COLMAP and the like) has the
poses of all, right up to a similarity.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.geometry import Camera, Pose
from lodbench.geometry.pose import cross_matrix, pose_from_vector
from lodbench.matching.protocol import Features, Matches
from lodbench.matching.sift import MutualNn, MutualNnParams, Sift, SiftParams
from lodbench.methods.flight.bundle import PairMatches
from lodbench.photos.pictures import read_picture

Floats = NDArray[np.float64]

# Pairs further off than so many sigmas count less and less (Cauchy's kernel).
_OUTLIER_SIGMAS = 3.0
# Photos nearer to each other than this have no direction between them, metres.
_NEAREST_M = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """A point ``x`` of the first photo's camera is ``rotation @ x + s direction`` in the other's, s open."""

    first: int  # number of the first photo
    second: int  # of the second
    rotation: Floats  # (3, 3) second_from_first
    direction: Floats  # (3,) unit, towards the first photo's centre in the second's camera
    information: Floats  # (5, 5) of the turn (radians, second camera's axes) and the direction (``tangents``)
    per_focal: Floats  # (5,) by how much both change per share that the focal length is longer than declared

    def linearize(
        self, vectors: Floats, derivatives: Sequence[Floats], focal: float
    ) -> tuple[Floats, Floats]:
        """Returns (5,) how far two poses are from it, and (5, 13) the change per unit of them and the focal.

        Eq. (F8) of docs/methods/flight.md. Of (P, 6) poses of all photos, their ``rotation_derivatives``, and
        the share that the focal length is longer than declared.
        """
        here, there = (pose_from_vector(vectors[k]) for k in (self.first, self.second))
        baseline = here.center - there.center
        length = max(float(np.linalg.norm(baseline)), _NEAREST_M)
        direction = there.rotation @ baseline / length
        across = tangents(self.direction)
        turn = there.rotation @ here.rotation.T
        residuals = np.concatenate([rotation_vector(turn @ self.rotation.T), across @ direction])
        jacobian = np.zeros((5, 13))
        per_metre = across @ (np.eye(3) - np.outer(direction, direction)) @ there.rotation / length
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
        """Returns (5, 5) the information, less for a pair far off; errors are a share of those declared."""
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


def _turn(vector: Floats) -> Floats:
    return np.asarray(scipy.spatial.transform.Rotation.from_rotvec(vector).as_matrix())


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
    """Poses of photos in the map, right up to a similarity."""

    poses: Mapping[int, Pose]  # by number of the photo
    middle: Floats  # (3,) what the similarity turns and scales about, metres
    information: Floats  # (6, 6) of each photo's centre (metres) and turn (radians, camera axes)
    # (3,) by how much its cameras are turned about their axes already, radians
    mount: Floats = field(default_factory=lambda: np.zeros(3))

    @property
    def photos(self) -> Sequence[int]:
        """Returns the numbers of its photos."""
        return list(self.poses)

    def part(self, numbers: Mapping[int, int], vectors: Floats) -> Reconstruction | None:
        """Returns it of some photos, by new numbers, at their poses, (P, 6); None of too few of them."""
        poses = {numbers[photo]: pose for photo, pose in self.poses.items() if photo in numbers}
        reconstruction = placed(poses, vectors, self.information)
        return None if reconstruction is None else replace(reconstruction, mount=self.mount)

    def moved(self, step: Floats) -> Reconstruction:
        """Returns it after a step of its (10,) unknowns. Eq. (F10) of docs/methods/flight.md."""
        turn, tip = (_turn(step[part]) for part in (slice(3, 6), MOUNT))
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

        Eq. (F10) of docs/methods/flight.md. Of (P, 6) poses of all photos, and their
        ``rotation_derivatives``.
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
        shares = np.repeat(scales, 3)
        return robust(self.information / np.outer(shares, shares), residuals)


def placed(poses: Mapping[int, Pose], vectors: Floats, information: Floats) -> Reconstruction | None:
    """Returns a reconstruction moved to where photos are thought to be, (P, 6); None of too few of them.

    The turn is the mean of what each photo says, so that a straight flight leaves none open; poses are by
    number of the photo, in its own frame, and the information, (6, 6), is of each of them.
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


# Photos are looked at no wider than this, pixels, and for so many features; of more photos than so many each
# is looked at less closely, but no narrower than that, for they tie each other the more often.
_WIDTH, _FEATURES, _CLOSELY, _NARROWEST = 2048, 4000, 100, 1024
# Each photo is paired with so many that were taken near it, which look the same way to within this, degrees.
_NEIGHBOURS, _ALIKE_DEG = 4, 50.0
# Features agree to within so many pixels; fewer that do say nothing. Points of one pair err together.
_REACH_PX, _FEWEST, _NOISE_PX, _HEAT = 1.5, 30, 0.3, 4.0
# So many pairs ahead features are looked for while others are compared.
_AHEAD = 4
_PhotoFeatures = tuple[Features, Camera]
# What is burned into both photos stands still to so many pixels. So does all of a pair from one place, of
# which less than this share moves.
_STILL_PX, _FEW_MOVE = 2.0, 0.1
# A pair's turn is no further from what sensors say than this, degrees.
_FURTHEST_DEG = 15.0
# By how much the focal length is changed to see what it does to a pair.
_FOCAL_STEP = 0.005


def relative_poses(queries: Sequence[Query], vectors: Floats) -> tuple[list[RelativePose], list[PairMatches]]:
    """Returns what features say of pairs of photos, and those that agree; none where there are no photos.

    Where they were taken is known about: (P, 6), metres and degrees.
    """
    width = width_looked_at(len(queries))
    sift = Sift(SiftParams(max_features=round(_FEATURES * (width / _WIDTH) ** 1.5)))
    matcher = MutualNn(MutualNnParams(ratio=0.8))
    pairs = _pairs(vectors)
    ties, shared = list[RelativePose](), list[PairMatches]()
    for (first, second), here, there in _features_of_pairs(queries, pairs, sift, width):
        matches = matcher.match(here[0], there[0])
        is_scene = _is_scene(matches, here[0].size == there[0].size)
        rays = [_rays(here[1], matches.first[is_scene]), _rays(there[1], matches.second[is_scene])]
        guess = pose_from_vector(vectors[second]).rotation @ pose_from_vector(vectors[first]).rotation.T
        tie = two_view(rays[0], rays[1], here[1].fx, guess)
        if tie is not None:
            *relative, agrees = tie
            ties.append(RelativePose(first, second, *relative))
            pixels = np.stack([matches.first[is_scene], matches.second[is_scene]])[:, agrees]
            shared.append(PairMatches(first, second, pixels.astype(np.float64), np.stack(rays)[:, agrees]))
    return ties, shared


def _features_of_pairs(
    queries: Sequence[Query], pairs: Sequence[tuple[int, int]], sift: Sift, widest: int
) -> Iterator[tuple[tuple[int, int], _PhotoFeatures, _PhotoFeatures]]:
    """Yields pairs whose photos can be read with both features; another thread is some pairs ahead.

    Features are held no longer than they are needed: hundreds of photos have gigabytes.
    """
    last = {photo: number for number, pair in enumerate(pairs) for photo in pair}
    futures: dict[int, Future[_PhotoFeatures | None]] = {}
    with ThreadPoolExecutor(1) as other:
        for number, pair in enumerate(pairs):
            for photo in (photo for near in pairs[number : number + _AHEAD] for photo in near):
                if photo not in futures:
                    futures[photo] = other.submit(_features, queries[photo], sift, widest)
            here, there = (
                (futures.pop(photo) if last[photo] == number else futures[photo]).result() for photo in pair
            )
            if here is not None and there is not None:
                yield pair, here, there


def width_looked_at(photos: int) -> int:
    """Returns how wide each of so many photos is looked at, pixels: the whole costs little more than 100."""
    return max(_NARROWEST, min(_WIDTH, round(_WIDTH * math.sqrt(_CLOSELY / max(photos, 1)))))


def two_view(
    first: Floats, second: Floats, focal_px: float, guess: Floats
) -> tuple[Floats, Floats, Floats, Floats, NDArray[np.bool_]] | None:
    """Returns the relative pose of two photos from points visible in both; None if they say none.

    Points, (N, 2), are at depth 1, x right and y down; the guess, (3, 3), is about how the second photo is
    turned against the first. Returned are the last four fields of ``RelativePose``, and (N,) which points
    agree.
    """
    if len(first) < _FEWEST:
        return None
    reach = _REACH_PX / focal_px
    matrix, _ = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, 0.9999, reach)
    if matrix is None or matrix.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(matrix, first, second, np.eye(3))
    start = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64).ravel()
    if np.degrees(np.linalg.norm(rotation_vector(start[0] @ guess.T))) > _FURTHEST_DEG:
        return None
    inside = np.abs(_sampson(first, second, *start)) < 2.0 * reach
    if np.count_nonzero(inside) < _FEWEST:
        return None
    one, other = first[inside], second[inside]
    rotation, direction, slopes, residuals = _refined(one, other, start, reach)
    noise = max(1.4826 * float(np.median(np.abs(residuals))), _NOISE_PX / focal_px)
    weights = 1.0 / (1.0 + (residuals / reach) ** 2) ** 2
    information = (slopes * weights[:, None]).T @ slopes / (_HEAT * noise**2)
    # With a longer lens the same pixels are nearer to the axis.
    shorter = 1.0 / (1.0 + _FOCAL_STEP)
    longer = _refined(one * shorter, other * shorter, (rotation, direction), reach)
    turned = np.concatenate([rotation_vector(longer[0] @ rotation.T), tangents(direction) @ longer[1]])
    return rotation, direction, information, turned / _FOCAL_STEP, inside


def _refined(
    first: Floats, second: Floats, start: tuple[Floats, Floats], reach: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Returns rotation and direction by least squares, slopes (N, 5) and residuals (N,) there."""
    rotation, direction = start
    across = tangents(direction)

    def residuals(step: Floats) -> Floats:
        return _sampson(first, second, *_stepped(rotation, direction, across, step))

    solution = scipy.optimize.least_squares(
        residuals, np.zeros(5), loss="cauchy", f_scale=reach, x_scale=0.01, max_nfev=20
    )
    rotation, direction = _stepped(rotation, direction, across, solution.x)
    across = tangents(direction)
    here, small = _sampson(first, second, rotation, direction), 1e-6
    moved = (_stepped(rotation, direction, across, small * unit) for unit in np.eye(5))
    slopes = np.stack([(_sampson(first, second, *each) - here) / small for each in moved], axis=1)
    return rotation, direction, slopes, here


def _stepped(rotation: Floats, direction: Floats, across: Floats, step: Floats) -> tuple[Floats, Floats]:
    moved = direction + step[3:] @ across
    return _turn(step[:3]) @ rotation, moved / np.linalg.norm(moved)


def _sampson(first: Floats, second: Floats, rotation: Floats, direction: Floats) -> Floats:
    """Returns (N,) signed distances of points to the epipolar constraint, to first order, at depth 1."""
    essential = cross_matrix(direction) @ rotation
    one = np.column_stack([first, np.ones(len(first))])
    other = np.column_stack([second, np.ones(len(second))])
    line, back = one @ essential.T, other @ essential
    steep = np.sqrt((line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    return np.asarray((other * line).sum(axis=1) / np.maximum(steep, 1e-12))


def _features(query: Query, sift: Sift, widest: int) -> _PhotoFeatures | None:
    """Returns a photo's features, and the camera they are pixels of; None for one that cannot be read."""
    camera = query.camera
    picture = None if query.image is None else read_picture(query.image)
    if picture is None:
        return None
    width = min(widest, picture.shape[1])
    size = width, max(1, round(width * camera.height / camera.width))
    if size != (picture.shape[1], picture.shape[0]):
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return sift.extract(np.ascontiguousarray(picture[..., ::-1])), camera.scaled(*size)


def _is_scene(matches: Matches, has_same_size: bool) -> NDArray[np.bool_]:
    """Returns (M,) which matches are of the scene: burned-in text stands still; all where few move."""
    moves = np.asarray(np.linalg.norm(matches.first - matches.second, axis=1) > _STILL_PX)
    if not has_same_size or np.count_nonzero(moves) < _FEW_MOVE * len(moves):
        return np.ones(len(moves), dtype=bool)
    return moves


def _rays(camera: Camera, pixels: NDArray[np.float32]) -> Floats:
    away = pixels.astype(np.float64) - np.array([camera.cx, camera.cy])
    return np.ascontiguousarray(away / np.array([camera.fx, camera.fy]))


def _pairs(vectors: Floats) -> list[tuple[int, int]]:
    """Returns the pairs of photos that may show the same, each once, the smaller number first."""
    axes = np.array([pose_from_vector(vector).rotation[2] for vector in vectors])
    apart_m = np.linalg.norm(vectors[:, None, :3] - vectors[None, :, :3], axis=2)
    apart_m[axes @ axes.T <= np.cos(np.radians(_ALIKE_DEG))] = np.inf
    np.fill_diagonal(apart_m, np.inf)
    nearest = np.argsort(apart_m, axis=1, kind="stable")[:, :_NEIGHBOURS].tolist()
    near = ((k, other) for k, row in enumerate(nearest) for other in row if np.isfinite(apart_m[k, other]))
    return sorted({(min(pair), max(pair)) for pair in near})
