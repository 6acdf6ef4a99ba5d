"""``poselib``: LO-RANSAC over three points as PoseLib has it (Larsson et al.), of the extra ``[pnp]``."""

from __future__ import annotations

import numpy as np

from lodbench.extras import require
from lodbench.geometry import Camera, Pose
from lodbench.matching.pose_solver import Floats, SolvedPose, SolverParams, agreeing

_FEWEST = 4


class PoselibPose:
    """Solves with PoseLib.

    Raises:
        ConfigError: It is not installed.
    """

    params_type = SolverParams

    def __init__(self, params: SolverParams) -> None:
        self.params = params
        self._library = require("poselib", "pnp", "pnp=poselib")

    def solve(self, points: Floats, pixels: Floats, camera: Camera, prior: Pose) -> SolvedPose | None:
        """Returns the pose, or None where none is found; see ``PoseSolver``."""
        if len(points) < _FEWEST:
            return None
        limit = self.params.threshold_px
        options = {
            # Two versions call the threshold by two names, and neither minds one it does not know.
            "max_reproj_error": limit,
            "max_error": limit,
            "max_iterations": self.params.max_iterations,
            "success_prob": self.params.confidence,
        }
        pinhole = {
            "model": "PINHOLE",
            "width": camera.width,
            "height": camera.height,
            "params": [camera.fx, camera.fy, camera.cx, camera.cy],
        }
        middle = np.median(points, axis=0)
        found, info = self._library.estimate_absolute_pose(pixels, points - middle, pinhole, options, {})
        if info.get("num_inliers", 0) < _FEWEST or not np.isfinite(found.Rt).all():
            return None
        turn, translation = np.asarray(found.R), np.asarray(found.t)
        pose = Pose.from_center(turn, middle - turn.T @ translation)
        return SolvedPose(pose, agreeing(points, pixels, camera, pose, limit))
