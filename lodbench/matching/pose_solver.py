"""What a pose solver is: from points of the world and where they are seen to the camera's pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import require_within
from lodbench.extras import require
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
