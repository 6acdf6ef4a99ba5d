"""Bundle adjustment: photos that share features become one rigid block, right up to a similarity.

A pair of photos leaves the direction between them open to a degree where the ground is flat; points that
three and more photos show do not. Each point is eliminated (Schur complement), so that only poses are solved
for (Triggs et al., "Bundle adjustment: a modern synthesis", 2000, section 6.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.estimation.edge_alignment import project, projection_slopes
from lodbench.estimation.optimization import NormalEquations
from lodbench.geometry import Camera, Pose
from lodbench.geometry.pose import pose_from_vector, rotation_derivatives

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

# Scales of Cauchy's kernel, pixels: first those of poses that are metres off, then that of features.
_REACHES_PX = (*np.geomspace(40.0, 2.0, 10), *([2.0] * 8))
# A point's rays meet at no less than this angle, degrees, or it says nothing of places.
_LEAST_ANGLE_DEG = 1.0
# Fewer observations of a photo do not place it. Observations further off than this are wrong, pixels.
_FEWEST, _WRONG_PX = 20, 3.0
# A camera whose pixels are rays at depth 1; nearer points have none, metres.
_AT_DEPTH_1, _NEAREST_M = Camera(1, 1, 1.0, 1.0, 0.0, 0.0), 1e-6
# Damping of points and poses, share of the diagonal (Levenberg and Marquardt).
_DAMPING = 1e-6


class PairMatches(NamedTuple):
    """Features that two photos share."""

    first: int  # number of the first photo
    second: int  # of the second
    pixels: Floats  # (2, N, 2) where either shows them, pixels of the size that features were looked for at
    rays: Floats  # (2, N, 2) the same at depth 1 in camera axes, x right and y down


class Observations(NamedTuple):
    """Points as photos show them."""

    photos: Rows  # (N,) numbers of photos
    points: Rows  # (N,) numbers of points, from 0
    rays: Floats  # (N, 2) where, at depth 1 in camera axes

    def of(self, chosen: NDArray[np.bool_]) -> Observations:
        """Returns some observations, points numbered anew; points that one photo alone shows are left out."""
        while True:
            _, points, counts = np.unique(self.points[chosen], return_inverse=True, return_counts=True)
            if (counts > 1).all():
                return Observations(self.photos[chosen], points, self.rays[chosen])
            rows = np.flatnonzero(chosen)
            chosen = np.zeros(len(chosen), dtype=bool)
            chosen[rows[counts[points] > 1]] = True


def observations_of(pairs: Sequence[PairMatches]) -> Observations:
    """Returns the points of matches: features that match each other, directly or through others, are one.

    Points that a photo would show at two places are left out: one of their matches is wrong.
    """
    if not pairs:
        return Observations(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
    photos = np.concatenate([np.repeat((pair.first, pair.second), pair.pixels.shape[1]) for pair in pairs])
    pixels = np.concatenate([pair.pixels.reshape(-1, 2) for pair in pairs])
    rays = np.concatenate([pair.rays.reshape(-1, 2) for pair in pairs])
    keys = np.column_stack([photos, pixels])
    _, where, feature = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    starts = np.cumsum([0, *(2 * pair.pixels.shape[1] for pair in pairs)])
    links = np.concatenate([feature[a:b].reshape(2, -1) for a, b in pairwise(starts)], axis=1)
    size = len(where)
    graph = scipy.sparse.coo_matrix((np.ones(links.shape[1]), (links[0], links[1])), (size, size))
    _, points = scipy.sparse.csgraph.connected_components(graph, directed=False)
    merged = Observations(photos[where].astype(np.int64), points.astype(np.int64), rays[where])
    _, twice, counts = np.unique(
        merged.points * (merged.photos.max() + 1) + merged.photos, return_inverse=True, return_counts=True
    )
    is_wrong = np.zeros(points.max() + 1, dtype=bool)
    is_wrong[merged.points[counts[twice] > 1]] = True
    return merged.of(~is_wrong[merged.points])


def block_of(
    pairs: Sequence[PairMatches], vectors: Floats, sigmas: Floats, focal_px: float
) -> dict[int, Pose]:
    """Returns the poses of photos that matches tie into one block, by number; see ``adjusted``."""
    observations = observations_of(pairs)
    if not len(observations.photos):
        return {}
    vectors, members = adjusted(observations, vectors, sigmas, focal_px)
    return {int(k): pose_from_vector(vectors[k]) for k in members}


def adjusted(
    observations: Observations, vectors: Floats, sigmas: Floats, focal_px: float
) -> tuple[Floats, Rows]:
    """Returns (P, 6) poses that agree on all points, metres and degrees, and the numbers of those that do.

    Where the block lies, how it is turned and how large it is comes from the poses it starts from.

    Args:
        observations: Of points.
        vectors: (P, 6) about where photos were taken.
        sigmas: (6,) how far each may be from there.
        focal_px: Pixels of the focal length, for the scale of what features err by.
    """
    start, kept = vectors, observations
    points = np.zeros((0, 3))
    for number, reach_px in enumerate(_REACHES_PX):
        # Points follow poses that move by metres only if they are laid anew.
        points = _triangulated(kept, vectors) if number < len(_REACHES_PX) // 2 else points
        step, moved, residuals = _step(kept, vectors, points, start, sigmas, reach_px / focal_px)
        vectors, points = vectors + step, points + moved
        if number == len(_REACHES_PX) // 2:
            is_right = np.linalg.norm(residuals, axis=1) < 3.0 * _WRONG_PX / focal_px
            kept = kept.of(is_right & _is_wide(kept, vectors, points)[kept.points])
            if not len(kept.photos):  # nothing is left that tells how far it is: photos from one place
                return start, np.zeros(0, dtype=np.int64)
            points = _triangulated(kept, vectors)
    counts = np.bincount(kept.photos, minlength=len(vectors))
    return vectors, np.flatnonzero(counts >= _FEWEST)


def _triangulated(observations: Observations, vectors: Floats) -> Floats:
    """Returns (T, 3) the points nearest to their rays, scene metres."""
    centers, rays = _lines(observations, vectors)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    count = int(observations.points.max(initial=-1)) + 1
    normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(normal, observations.points, across)
    np.add.at(right, observations.points, (across @ centers[:, :, None])[..., 0])
    # Rays that are nearly parallel leave the depth open: a little curvature keeps an inverse.
    return np.asarray(np.linalg.solve(normal + 1e-9 * np.eye(3), right[..., None])[..., 0])


def _lines(observations: Observations, vectors: Floats) -> tuple[Floats, Floats]:
    """Returns the centres (N, 3) and directions (N, 3) of rays, scene frame."""
    poses = [pose_from_vector(vector) for vector in vectors]
    rotations, centers = np.array([p.rotation for p in poses]), np.array([p.center for p in poses])
    rays = np.column_stack([observations.rays, np.ones(len(observations.rays))])
    rays = np.einsum(
        "nij,ni->nj", rotations[observations.photos], rays / np.linalg.norm(rays, axis=1)[:, None]
    )
    return centers[observations.photos], rays


def _is_wide(observations: Observations, vectors: Floats, points: Floats) -> NDArray[np.bool_]:
    """Returns (T,) whether a point's rays meet at an angle that shows how far it is."""
    _, rays = _lines(observations, vectors)
    count = len(points)
    mean = np.zeros((count, 3))
    np.add.at(mean, observations.points, rays)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
    away = np.zeros(count)
    cosines = (rays * mean[observations.points]).sum(axis=1)
    np.maximum.at(away, observations.points, np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))))
    return np.asarray(2.0 * away > _LEAST_ANGLE_DEG)


def _step(
    observations: Observations, vectors: Floats, points: Floats, start: Floats, sigmas: Floats, reach: float
) -> tuple[Floats, Floats, Floats]:
    """Returns a Gauss-Newton step of poses (P, 6) and of points (T, 3), and residuals (N, 2) before it.

    Eq. (F9) of docs/methods/flight.md.
    """
    of_pose, of_point, residuals = _linearized(observations, vectors, points)
    weights = 1.0 / (1.0 + (residuals**2).sum(axis=1) / reach**2) / reach**2
    in_front = np.isfinite(weights)
    weights = np.where(in_front, weights, 0.0)
    residuals = np.where(in_front[:, None], residuals, 0.0)
    weighted = of_point * weights[:, None, None]
    curvature = np.zeros((len(points), 3, 3))
    slope = np.zeros((len(points), 3))
    np.add.at(curvature, observations.points, np.einsum("nki,nkj->nij", weighted, of_point))
    np.add.at(slope, observations.points, np.einsum("nki,nk->ni", weighted, residuals))
    trace = np.trace(curvature, axis1=1, axis2=2)
    inverse = np.linalg.inv(curvature + (_DAMPING * trace + 1e-12)[:, None, None] * np.eye(3))
    mixed = np.einsum("nki,nkj->nij", of_pose * weights[:, None, None], of_point)
    equations = NormalEquations(vectors.size)
    precision = sigmas**-2.0
    own = np.einsum("nki,nkj->nij", of_pose * weights[:, None, None], of_pose)
    pull = np.einsum("nki,nk->ni", of_pose * weights[:, None, None], residuals)
    pull -= np.einsum("nij,njk,nk->ni", mixed, inverse[observations.points], slope[observations.points])
    count = len(vectors)
    for photo in range(count):
        mine = observations.photos == photo
        away = vectors[photo] - start[photo]
        equations.add(
            6 * photo + np.arange(6),
            own[mine].sum(axis=0) + np.diag(precision),
            pull[mine].sum(axis=0) + precision * away,
        )
    equations.add_sparse(-_eliminated(observations, mixed, inverse, vectors.size))
    _, step = equations.solve(count)
    poses = step.reshape(-1, 6)
    at_points = np.zeros((len(points), 3))
    np.add.at(at_points, observations.points, np.einsum("nij,ni->nj", mixed, poses[observations.photos]))
    moved = -np.einsum("nij,nj->ni", inverse, slope + at_points)
    return poses, moved, residuals


def _eliminated(
    observations: Observations, mixed: Floats, inverse: Floats, size: int
) -> scipy.sparse.coo_matrix:
    """Returns what eliminated points take from the curvature of poses, (size, size)."""
    rows = 6 * observations.photos[:, None, None] + np.arange(6)[:, None] + np.zeros(3, np.int64)
    columns = 3 * observations.points[:, None, None] + np.arange(3) + np.zeros((6, 1), np.int64)
    to_points = scipy.sparse.csr_matrix(
        (mixed.ravel(), (rows.ravel(), columns.ravel())), (size, 3 * len(inverse))
    )
    count = np.arange(len(inverse))
    of_points = scipy.sparse.bsr_matrix((inverse, count, np.arange(len(inverse) + 1)))
    return scipy.sparse.coo_matrix(to_points @ of_points @ to_points.T)


def _linearized(observations: Observations, vectors: Floats, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Returns slopes by pose (N, 2, 6) and by point (N, 2, 3), and residuals (N, 2), depth 1."""
    poses = [pose_from_vector(vector) for vector in vectors]
    rotations = np.array([pose.rotation for pose in poses])[observations.photos]
    away = points[observations.points] - np.array([pose.center for pose in poses])[observations.photos]
    derivatives = np.array([rotation_derivatives(vector) for vector in vectors])[observations.photos]
    local = np.einsum("nij,nj->ni", rotations, away)
    local[local[:, 2] <= _NEAREST_M] = np.nan
    shown = project(local, _AT_DEPTH_1)
    per_local = np.nan_to_num(projection_slopes(local, _AT_DEPTH_1)[:, :, :3])
    of_point = per_local @ rotations
    turned = np.einsum("nkij,nj->nki", derivatives, away)
    of_angles = np.einsum("nij,nkj->nik", per_local, turned)
    return np.concatenate([-of_point, of_angles], axis=2), of_point, shown - observations.rays
