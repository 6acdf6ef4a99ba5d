"""``pycolmap``: COLMAP's LO-RANSAC over three points and its refinement, of the extra ``[pnp]``."""

from __future__ import annotations

import numpy as np

from lodbench.extras import require
from lodbench.geometry import Camera, Pose
from lodbench.matching.pose_solver import Floats, SolvedPose, SolverParams, agreeing

_FEWEST = 4


class PycolmapPose:
    """Solves with pycolmap, as the published pipelines do.

    Raises:
        ConfigError: It is not installed.
    """

    params_type = SolverParams

    def __init__(self, params: SolverParams) -> None:
        self.params = params
        self._library = require("pycolmap", "pnp", "pnp=pycolmap")

    def solve(self, points: Floats, pixels: Floats, camera: Camera, prior: Pose) -> SolvedPose | None:
        """Returns the pose, or None where none is found; see ``PoseSolver``."""
        if len(points) < _FEWEST:
            return None
        options = self._library.AbsolutePoseEstimationOptions()
        options.ransac.max_error = self.params.threshold_px
        options.ransac.max_num_trials = self.params.max_iterations
        options.ransac.confidence = self.params.confidence
        options.ransac.random_seed = 0
        pinhole = self._library.Camera(
            model="PINHOLE",
            width=camera.width,
            height=camera.height,
            params=[camera.fx, camera.fy, camera.cx, camera.cy],
        )
        middle = np.median(points, axis=0)
        found = self._library.estimate_and_refine_absolute_pose(pixels, points - middle, pinhole, options)
        if found is None or found["num_inliers"] < _FEWEST:
            return None
        matrix = np.asarray(found["cam_from_world"].matrix())
        turn = matrix[:, :3]
        pose = Pose.from_center(turn, middle - turn.T @ matrix[:, 3])
        return SolvedPose(pose, agreeing(points, pixels, camera, pose, self.params.threshold_px))
