"""Features that neighbouring photos share: their relative pose from pixels, with what it leaves open."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.geometry import Camera
from lodbench.geometry.pose import cross_matrix, pose_from_vector
from lodbench.matching.mutual_nn import MutualNn, MutualNnParams
from lodbench.matching.protocol import Features, Matches
from lodbench.matching.sift import Sift, SiftParams
from lodbench.methods.flight.bundle import PairMatches
from lodbench.methods.flight.relative_poses import RelativePose, tangents
from lodbench.photos.pictures import read_picture

Floats = NDArray[np.float64]

# Photos are looked at no wider than this, pixels, and for so many features; of more photos than so many each
# is looked at less closely, but no narrower than that, for they tie each other the more often.
_WIDTH, _FEATURES, _CLOSELY, _NARROWEST = 2048, 4000, 100, 1024
# Each photo is paired with so many that were taken near it, which look the same way to within this, degrees.
_NEIGHBOURS, _ALIKE_DEG = 4, 50.0
# Features agree to within so many pixels; fewer that do say nothing. Points of one pair err together.
_REACH_PX, _FEWEST, _NOISE_PX, _HEAT = 1.5, 30, 0.3, 4.0
# What is burned into both photos stands still to so many pixels. So does all of a pair from one place, of
# which less than this share moves.
_STILL_PX, _FEW_MOVE = 2.0, 0.1
# A pair's turn is no further from what sensors say than this, degrees.
_FURTHEST_DEG = 15.0
# By how much the focal length is changed to see what it does to a pair.
_FOCAL_STEP = 0.005


def relative_poses(queries: Sequence[Query], vectors: Floats) -> tuple[list[RelativePose], list[PairMatches]]:
    """Returns what features say of pairs of photos, and those that agree; none where there are no photos.

    Args:
        queries: The flight's.
        vectors: (P, 6) about where they were taken, metres and degrees.
    """
    width = width_looked_at(len(queries))
    sift = Sift(SiftParams(max_features=round(_FEATURES * (width / _WIDTH) ** 1.5)))
    matcher = MutualNn(MutualNnParams(ratio=0.8))
    pairs, found = _pairs(vectors), dict[int, tuple[Features, Camera] | None]()
    ties, shared = list[RelativePose](), list[PairMatches]()
    last = {photo: number for number, pair in enumerate(pairs) for photo in pair}
    for number, (first, second) in enumerate(pairs):
        for photo in (first, second):
            if photo not in found:
                found[photo] = _features(queries[photo], sift, width)
        # Features are held no longer than they are needed: hundreds of photos have gigabytes.
        here, there = (
            found.pop(photo) if last[photo] == number else found[photo] for photo in (first, second)
        )
        if here is None or there is None:
            continue
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


def width_looked_at(photos: int) -> int:
    """Returns how wide each of so many photos is looked at, pixels: the whole costs little more than 100."""
    return max(_NARROWEST, min(_WIDTH, round(_WIDTH * math.sqrt(_CLOSELY / max(photos, 1)))))


def two_view(
    first: Floats, second: Floats, focal_px: float, guess: Floats
) -> tuple[Floats, Floats, Floats, Floats, NDArray[np.bool_]] | None:
    """Returns the relative pose of two photos from points seen in both; None if they say none.

    Args:
        first: (N, 2) points of the first photo at depth 1, x right and y down.
        second: (N, 2) of the second.
        focal_px: Pixels of their focal length.
        guess: (3, 3) about how the second photo is turned against the first.

    Returns:
        Rotation (3, 3), direction (3,), information (5, 5) and change per share of the focal length (5,),
        see ``RelativePose``; and (N,) which points agree with it.
    """
    if len(first) < _FEWEST:
        return None
    reach = _REACH_PX / focal_px
    matrix, _ = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, 0.9999, reach)
    if matrix is None or matrix.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(matrix, first, second, np.eye(3))
    start = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64).ravel()
    away_deg = np.degrees(np.linalg.norm(cv2.Rodrigues(start[0] @ guess.T)[0]))
    if away_deg > _FURTHEST_DEG:
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
    turned = np.concatenate(
        [cv2.Rodrigues(longer[0] @ rotation.T)[0].ravel(), tangents(direction) @ longer[1]]
    )
    return rotation, direction, information, turned / _FOCAL_STEP, inside


def _refined(
    first: Floats, second: Floats, start: tuple[Floats, Floats], reach: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Returns rotation and direction by least squares, slopes (N, 5) and residuals (N,) there."""
    rotation, direction = start
    across = tangents(direction)

    def residuals(step: Floats) -> Floats:
        return _sampson(first, second, *_stepped(rotation, direction, across, step))

    found = scipy.optimize.least_squares(
        residuals, np.zeros(5), loss="cauchy", f_scale=reach, x_scale=0.01, max_nfev=20
    )
    rotation, direction = _stepped(rotation, direction, across, found.x)
    across = tangents(direction)
    small = 1e-6
    here = residuals_here = _sampson(first, second, rotation, direction)
    slopes = np.stack(
        [
            (_sampson(first, second, *_stepped(rotation, direction, across, small * unit)) - here) / small
            for unit in np.eye(5)
        ],
        axis=1,
    )
    return rotation, direction, slopes, residuals_here


def _stepped(rotation: Floats, direction: Floats, across: Floats, step: Floats) -> tuple[Floats, Floats]:
    moved = direction + step[3:] @ across
    return scipy.spatial.transform.Rotation.from_rotvec(
        step[:3]
    ).as_matrix() @ rotation, moved / np.linalg.norm(moved)


def _sampson(first: Floats, second: Floats, rotation: Floats, direction: Floats) -> Floats:
    """Returns (N,) signed distances of points to the epipolar constraint, to first order, at depth 1."""
    essential = cross_matrix(direction) @ rotation
    one = np.column_stack([first, np.ones(len(first))])
    other = np.column_stack([second, np.ones(len(second))])
    line, back = one @ essential.T, other @ essential
    steep = np.sqrt((line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    return np.asarray((other * line).sum(axis=1) / np.maximum(steep, 1e-12))


def _features(query: Query, sift: Sift, widest: int) -> tuple[Features, Camera] | None:
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
    """Returns (M,) which matches are of the scene: text or a logo burned in stands still.

    Still ones agree so well that they would win; all are kept where next to none moves.
    """
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
    is_alike = axes @ axes.T > np.cos(np.radians(_ALIKE_DEG))
    apart_m[~is_alike] = np.inf
    np.fill_diagonal(apart_m, np.inf)
    pairs = set()
    for photo, row in enumerate(apart_m):
        for other in np.argsort(row, kind="stable")[:_NEIGHBOURS]:
            if np.isfinite(row[other]):
                pairs.add((min(photo, int(other)), max(photo, int(other))))
    return sorted(pairs)
