"""What a pose solver is: from points of the world and where they are seen to the camera's pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import require_within
from lodbench.geometry import Camera, Pose
from lodbench.params import to_params
from lodbench.plugins import load_plugin

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SolverParams:
    """Settings that all pose solvers have.

    Attributes:
        threshold_px: A point seen further than this from where a pose puts it speaks against the pose.
        max_iterations: Samples drawn at most.
        confidence: Wanted probability that one sample was free of outliers.
    """

    threshold_px: float = 8.0
    max_iterations: int = 20_000
    confidence: float = 0.9999

    def __post_init__(self) -> None:
        require_within("threshold_px", self.threshold_px, 0, ends="(]")
        require_within("max_iterations", self.max_iterations, 1)
        require_within("confidence", self.confidence, 0, 1, "()")


@dataclass(frozen=True, slots=True, eq=False)
class SolvedPose:
    """A pose that many correspondences agree on.

    Attributes:
        pose: In the points' frame, refined on the inliers.
        inliers: (N,) bool, which correspondences agree.
    """

    pose: Pose
    inliers: NDArray[np.bool_]


class PoseSolver(Protocol):
    """Finds a pose among outliers; made from its ``params_type``. The same input gives the same pose."""

    def solve(self, points: Floats, pixels: Floats, camera: Camera, prior: Pose) -> SolvedPose | None:
        """Returns the pose, or None where none is found.

        Args:
            points: (N, 3) world points, metres.
            pixels: (N, 2) where they are seen, COLMAP pixels.
            camera: Pinhole.
            prior: The rough pose; a solver may take gravity from it, and nothing else.
        """
        ...


def open_pose_solver(name: str, **settings: Any) -> PoseSolver:
    """Returns the pose solver of a name.

    Raises:
        ConfigError: There is none, it is broken, its library is absent, or a setting is out of range.
    """
    kind = load_plugin("pose_solvers", name)
    solver: PoseSolver = kind(to_params(settings, kind.params_type, name))
    return solver


def reprojection_error_px(points: Floats, pixels: Floats, camera: Camera, pose: Pose) -> Floats:
    """Returns (N,) distances between where points are seen and where a pose puts them; inf behind it."""
    seen = camera.project((points - pose.center) @ pose.rotation.T)
    return np.asarray(np.nan_to_num(np.linalg.norm(seen - pixels, axis=1), nan=np.inf))


def agreeing(
    points: Floats, pixels: Floats, camera: Camera, pose: Pose, threshold_px: float
) -> NDArray[np.bool_]:
    """Returns (N,) which correspondences a pose explains."""
    return np.asarray(reprojection_error_px(points, pixels, camera, pose) < threshold_px)
