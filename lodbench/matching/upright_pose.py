"""``upright``: RANSAC over two points where gravity is known from the prior, then all six degrees refined.

With pitch and roll given, two points determine a pose: the difference of their heights and their distance
on the plan give their depths by a quadratic; yaw and place follow. Two points are free of outliers far more
often than three. What the prior's tilt is off by is allowed for by a wider threshold, and made good by the
refinement.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import require_within
from lodbench.geometry import Camera, Pose, rotations_at_yaws
from lodbench.matching.pose_solver import Floats, SolvedPose, SolverParams, agreeing

_FEWEST = 4
# Samples scored at a time, and points they are scored on at most.
_BATCH, _MOST_SCORED = 256, 1500
_REFINEMENTS = 3


@dataclass(frozen=True, slots=True)
class UprightParams(SolverParams):
    """Settings of the upright solver, besides those of all.

    Attributes:
        max_iterations: Samples drawn; each pair of points gives up to two poses.
        tilt_allowance: Factor on the threshold while the tilt is the prior's.
    """

    max_iterations: int = 2000
    tilt_allowance: float = 3.0

    def __post_init__(self) -> None:
        super(UprightParams, self).__post_init__()
        require_within("tilt_allowance", self.tilt_allowance, 1)


class UprightPose:
    """Solves with gravity from the prior; numpy, and OpenCV's refinement."""

    params_type = UprightParams

    def __init__(self, params: UprightParams) -> None:
        self.params = params

    def solve(self, points: Floats, pixels: Floats, camera: Camera, prior: Pose) -> SolvedPose | None:
        """Returns the pose, or None where none is found; see ``PoseSolver``."""
        if len(points) < _FEWEST:
            return None
        middle = np.median(points, axis=0)
        near = points - middle
        pitch_deg, roll_deg, _ = prior.euler
        level = rotations_at_yaws(pitch_deg, roll_deg, np.zeros(1))[0]
        rays = np.c_[(pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(pixels))] @ level
        generator = np.random.default_rng(0)
        scored = np.arange(len(near))
        if len(near) > _MOST_SCORED:
            scored = np.sort(generator.permutation(len(near))[:_MOST_SCORED])
        limit = self.params.tilt_allowance * self.params.threshold_px
        best, best_cost = None, np.inf
        for start in range(0, self.params.max_iterations, _BATCH):
            count = min(_BATCH, self.params.max_iterations - start)
            pairs = generator.integers(len(near), size=(count, 2))
            yaws, centers = poses_of_pairs(near[pairs], rays[pairs])
            for yaw, center in zip(yaws, centers, strict=True):
                pose = Pose.from_center(_turned(level, yaw), center)
                cost = _cost(near[scored], pixels[scored], camera, pose, limit)
                if cost < best_cost:
                    best, best_cost = pose, cost
        if best is None:
            return None
        return self._refined(near, pixels, camera, best, middle)

    def _refined(
        self, near: Floats, pixels: Floats, camera: Camera, pose: Pose, middle: Floats
    ) -> SolvedPose | None:
        """Returns the pose refined in all six degrees on what agrees, the threshold closing in."""
        for step in range(_REFINEMENTS):
            widened = max(1.0, self.params.tilt_allowance * (1 - step / (_REFINEMENTS - 1)))
            kept = agreeing(near, pixels, camera, pose, widened * self.params.threshold_px)
            if kept.sum() < _FEWEST:
                return None
            turn, shift = cv2.solvePnPRefineLM(
                near[kept],
                pixels[kept],
                camera.matrix,
                None,
                cv2.Rodrigues(pose.rotation)[0],
                (-pose.rotation @ pose.center)[:, None],
            )
            rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
            center = np.asarray(-rotation.T @ shift.ravel(), dtype=np.float64)
            if not np.isfinite(center).all():
                return None
            pose = Pose.from_center(rotation, center)
        inliers = agreeing(near, pixels, camera, pose, self.params.threshold_px)
        return SolvedPose(Pose.from_center(pose.rotation, pose.center + middle), inliers)


def poses_of_pairs(points: Floats, rays: Floats) -> tuple[Floats, Floats]:
    """Returns the poses from which pairs of points are seen along pairs of rays, both depths positive.

    Args:
        points: (N, 2, 3) metres.
        rays: (N, 2, 3) in axes that only a turn about the vertical parts from the world's.

    Returns:
        (M,) that turn, radians, counter-clockwise from the rays' axes to the world's, and (M, 3) centres.
    """
    apart = points[:, 0] - points[:, 1]
    # Depths a and b with a r0 - b r1 = apart, but for the turn: heights are equal, and lengths on the plan.
    first, second = rays[:, 0], rays[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        offset, share = apart[:, 2] / first[:, 2], second[:, 2] / first[:, 2]
        slope = share[:, None] * first[:, :2] - second[:, :2]
        start = offset[:, None] * first[:, :2]
        a, b = (slope**2).sum(axis=1), (slope * start).sum(axis=1)
        c = (start**2).sum(axis=1) - (apart[:, :2] ** 2).sum(axis=1)
        root = np.sqrt(b * b - a * c)
        depths = np.stack([(-b + root) / a, (-b - root) / a])
    found_yaws, found_centers = [], []
    for other in depths:
        depth = offset + other * share
        kept = np.isfinite(depth) & np.isfinite(other) & (depth > 0) & (other > 0)
        seen = (depth[:, None] * first - other[:, None] * second)[kept]
        real = apart[kept]
        yaw = np.arctan2(real[:, 1], real[:, 0]) - np.arctan2(seen[:, 1], seen[:, 0])
        reach = (depth[:, None] * first)[kept]
        x = np.cos(yaw) * reach[:, 0] - np.sin(yaw) * reach[:, 1]
        y = np.sin(yaw) * reach[:, 0] + np.cos(yaw) * reach[:, 1]
        found_yaws.append(yaw)
        found_centers.append(points[kept, 0] - np.stack([x, y, reach[:, 2]], axis=1))
    return np.concatenate(found_yaws), np.concatenate(found_centers)


def _turned(level: Floats, yaw: float) -> Floats:
    """Returns cam_from_world of a camera at yaw 0 turned about the vertical."""
    c, s = np.cos(yaw), np.sin(yaw)
    back: NDArray[np.float64] = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(level @ back)


def _cost(near: Floats, pixels: Floats, camera: Camera, pose: Pose, limit_px: float) -> float:
    """Returns the sum of squared errors, each at most the limit's (MSAC)."""
    seen = camera.project((near - pose.center) @ pose.rotation.T)
    square = np.nan_to_num(((seen - pixels) ** 2).sum(axis=1), nan=np.inf)
    return float(np.minimum(square, limit_px**2).sum())
