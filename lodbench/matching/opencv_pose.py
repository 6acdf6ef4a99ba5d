"""``opencv``: MAGSAC++ over three points (OpenCV's USAC), refined by Levenberg and Marquardt."""

from __future__ import annotations

import cv2
import numpy as np

from lodbench.geometry import Camera, Pose
from lodbench.matching.pose_solver import Floats, SolvedPose, SolverParams, agreeing

_FEWEST = 4


class OpencvPose:
    """Solves with OpenCV, which the base install has."""

    params_type = SolverParams

    def __init__(self, params: SolverParams) -> None:
        self.params = params

    def solve(self, points: Floats, pixels: Floats, camera: Camera, prior: Pose) -> SolvedPose | None:
        """Returns the pose, or None where none is found; see ``PoseSolver``."""
        if len(points) < _FEWEST:
            return None
        options = cv2.UsacParams()
        options.threshold = self.params.threshold_px
        options.maxIterations = self.params.max_iterations
        options.confidence = self.params.confidence
        options.sampler = cv2.SAMPLING_UNIFORM
        options.score = cv2.SCORE_METHOD_MAGSAC
        options.loMethod = cv2.LOCAL_OPTIM_SIGMA
        options.randomGeneratorState = 1
        # Round a middle near the points: OpenCV's solvers lose digits on large coordinates.
        middle = np.median(points, axis=0)
        near = np.ascontiguousarray(points - middle)
        # OpenCV's pixels begin half a pixel later than COLMAP's; K and pixels shift alike.
        try:
            found, _, rotation, translation, inliers = cv2.solvePnPRansac(
                near, np.ascontiguousarray(pixels), camera.matrix, None, params=options
            )
        except cv2.error:  # degenerate samples
            return None
        if not found or inliers is None or len(inliers) < _FEWEST:
            return None
        chosen = inliers.ravel()
        rotation, translation = cv2.solvePnPRefineLM(
            near[chosen], pixels[chosen], camera.matrix, None, rotation, translation
        )
        turn = np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64)
        center = np.asarray(middle - turn.T @ translation.ravel(), dtype=np.float64)
        if not np.isfinite(center).all():
            return None
        pose = Pose.from_center(turn, center)
        return SolvedPose(pose, agreeing(points, pixels, camera, pose, self.params.threshold_px))
