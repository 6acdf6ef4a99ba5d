"""Rules of what solves for poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import Pose
from lodbench.harness.conformance.trial import CAMERA, Rules, Tried, require
from lodbench.matching.pose_solver import SolvedPose
from lodbench.storage import random_stream

Floats = NDArray[np.float64]

_COUNT, _OUTLIERS = 300, 0.3


def solver_rules(tried: Tried) -> Rules:
    """Returns the rules of a pose solver."""

    def exact(outliers: float, limit_m: float) -> str:
        worst = 0.0
        for answer, truth in _solved(tried, outliers):
            if answer is None:
                require(False, "no pose")
                continue
            require(isinstance(answer, SolvedPose), f"solve returned {type(answer).__name__}")
            require(answer.inliers.shape == (_COUNT,), f"inliers are {answer.inliers.shape}, not ({_COUNT},)")
            worst = max(worst, float(np.linalg.norm(answer.pose.center - truth.center)))
        require(worst < limit_m, f"{worst:.2f} m off", "Pixels are COLMAP's, poses cam_from_world.")
        return f"{worst:.3f} m off at worst"

    def same_again() -> str:
        twice = _solved(tried, _OUTLIERS), _solved(tried, _OUTLIERS)
        for (first, _), (again, _) in zip(*twice, strict=True):
            same = first is not None and again is not None
            require(
                same and np.array_equal(first.pose.cam_from_world, again.pose.cam_from_world),  # type: ignore[union-attr]
                "another pose of the same correspondences",
                "Fix the seeds.",
            )
        return "the same correspondences, the same pose to the bit"

    def too_few() -> str:
        require(all(answer is None for answer, _ in _solved(tried, 0.0, count=1)), "a pose of one point")
        return "no pose of one point"

    return [
        ("exact", lambda: exact(0.0, 0.05)),
        ("outliers", lambda: exact(_OUTLIERS, 0.5)),
        ("same again", same_again),
        ("too few", too_few),
    ]


def _solved(tried: Tried, outliers: float, count: int = _COUNT) -> list[tuple[SolvedPose | None, Pose]]:
    """Returns the answer for each true pose, given so many of its correspondences, and that pose."""
    found = []
    for number, truth in enumerate(tried.truths):
        points, pixels = _correspondences(truth, outliers, number)
        prior = truth.shifted([8.0, -6.0, 4.0])
        answer = tried.make().solve(points[:count], pixels[:count], CAMERA, prior)
        found.append((answer, truth))
    return found


def _correspondences(truth: Pose, outliers: float, number: int) -> tuple[Floats, Floats]:
    """Returns points in view of a pose and where they are seen, half a pixel off where some are wrong."""
    stream = random_stream(0, "conformance", "correspondences", number)
    pixels = stream.uniform(size=(_COUNT, 2)) * (CAMERA.width, CAMERA.height)
    depth = stream.uniform(90.0, 150.0, size=_COUNT)
    rays = np.stack(
        [(pixels[:, 0] - CAMERA.cx) / CAMERA.fx, (pixels[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(_COUNT)], 1
    )
    points = (rays * depth[:, None]) @ truth.rotation + truth.center
    if outliers:
        pixels = pixels + stream.normal(scale=0.5, size=pixels.shape)
        wrong = stream.uniform(size=_COUNT) < outliers
        pixels[wrong] = stream.uniform(size=(int(wrong.sum()), 2)) * (CAMERA.width, CAMERA.height)
    return points, pixels
