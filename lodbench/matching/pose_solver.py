"""What a pose solver is: from points of the world and where they are seen to the camera's pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import require_within
from lodbench.extras import require
from lodbench.geometry import Camera, Pose, rotations_at_yaws
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
    """A pose that many correspondences agree on."""

    pose: Pose  # in the points' frame, refined on the inliers
    inliers: NDArray[np.bool_]  # (N,) bool, which correspondences agree


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
    projected = camera.project((points - pose.center) @ pose.rotation.T)
    return np.asarray(np.nan_to_num(np.linalg.norm(projected - pixels, axis=1), nan=np.inf))


def agreeing(
    points: Floats, pixels: Floats, camera: Camera, pose: Pose, threshold_px: float
) -> NDArray[np.bool_]:
    """Returns (N,) which correspondences a pose explains."""
    return np.asarray(reprojection_error_px(points, pixels, camera, pose) < threshold_px)


_FEWEST = 4


class _Solver:
    """What solvers share: points about their middle, since solvers lose digits on large coordinates.

    Raises:
        ConfigError: Its library is not installed.
    """

    params_type = SolverParams
    package = ""

    def __init__(self, params: SolverParams) -> None:
        self.params = params
        self._library: Any = require(self.package, "pnp", f"pnp={self.package}") if self.package else None

    def solve(self, points: Floats, pixels: Floats, camera: Camera, prior: Pose) -> SolvedPose | None:
        """Returns the pose, or None where none is found; see ``PoseSolver``."""
        if len(points) < _FEWEST:
            return None
        middle = np.median(points, axis=0)
        solution = self._estimate(np.ascontiguousarray(points - middle), np.ascontiguousarray(pixels), camera)
        if solution is None:
            return None
        turn, translation = solution
        center = np.asarray(middle - turn.T @ translation, dtype=np.float64)
        if not np.isfinite(center).all():
            return None
        pose = Pose.from_center(turn, center)
        return SolvedPose(pose, agreeing(points, pixels, camera, pose, self.params.threshold_px))

    def _estimate(self, near: Floats, pixels: Floats, camera: Camera) -> tuple[Floats, Floats] | None:
        """Returns cam_from_world of the near points, (3, 3) and (3,); None where too few agree."""
        raise NotImplementedError


class OpencvPose(_Solver):
    """Solves with OpenCV, which the base install has."""

    def _estimate(self, near: Floats, pixels: Floats, camera: Camera) -> tuple[Floats, Floats] | None:
        options = cv2.UsacParams()
        options.threshold = self.params.threshold_px
        options.maxIterations = self.params.max_iterations
        options.confidence = self.params.confidence
        options.sampler = cv2.SAMPLING_UNIFORM
        options.score = cv2.SCORE_METHOD_MAGSAC
        options.loMethod = cv2.LOCAL_OPTIM_SIGMA
        options.randomGeneratorState = 1
        # OpenCV's pixels begin half a pixel later than COLMAP's; K and pixels shift alike.
        try:
            found, _, rotation, translation, inliers = cv2.solvePnPRansac(
                near, pixels, camera.matrix, None, params=options
            )
        except cv2.error:  # degenerate samples
            return None
        if not found or inliers is None or len(inliers) < _FEWEST:
            return None
        chosen = inliers.ravel()
        rotation, translation = cv2.solvePnPRefineLM(
            near[chosen], pixels[chosen], camera.matrix, None, rotation, translation
        )
        turn, shift = cv2.Rodrigues(rotation)[0], translation.ravel()
        return np.asarray(turn, dtype=np.float64), np.asarray(shift, dtype=np.float64)


class PoselibPose(_Solver):
    """Solves with PoseLib."""

    package = "poselib"

    def _estimate(self, near: Floats, pixels: Floats, camera: Camera) -> tuple[Floats, Floats] | None:
        options = {
            # Two versions call the threshold by two names, and neither minds one it does not know.
            "max_reproj_error": self.params.threshold_px,
            "max_error": self.params.threshold_px,
            "max_iterations": self.params.max_iterations,
            "success_prob": self.params.confidence,
        }
        pose, info = self._library.estimate_absolute_pose(pixels, near, _pinhole(camera), options, {})
        if info.get("num_inliers", 0) < _FEWEST or not np.isfinite(pose.Rt).all():
            return None
        return np.asarray(pose.R), np.asarray(pose.t)


class PycolmapPose(_Solver):
    """Solves with pycolmap, as the published pipelines do."""

    package = "pycolmap"

    def _estimate(self, near: Floats, pixels: Floats, camera: Camera) -> tuple[Floats, Floats] | None:
        options = self._library.AbsolutePoseEstimationOptions()
        options.ransac.max_error = self.params.threshold_px
        options.ransac.max_num_trials = self.params.max_iterations
        options.ransac.confidence = self.params.confidence
        options.ransac.random_seed = 0
        pinhole = self._library.Camera(**_pinhole(camera))
        solution = self._library.estimate_and_refine_absolute_pose(pixels, near, pinhole, options)
        if solution is None or solution["num_inliers"] < _FEWEST:
            return None
        matrix = np.asarray(solution["cam_from_world"].matrix())
        return matrix[:, :3], matrix[:, 3]


def _pinhole(camera: Camera) -> dict[str, Any]:
    params = [camera.fx, camera.fy, camera.cx, camera.cy]
    return {"model": "PINHOLE", "width": camera.width, "height": camera.height, "params": params}


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
    """Returns the poses from which pairs of points are visible along pairs of rays, both depths positive.

    Points are (N, 2, 3) metres, rays (N, 2, 3) in axes that only a turn about the vertical parts from the
    world's. Returned are (M,) that turn, radians, counter-clockwise from the rays' axes to the world's, and
    (M, 3) centres.
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
    yaws, centers = [], []
    for other in depths:
        depth = offset + other * share
        kept = np.isfinite(depth) & np.isfinite(other) & (depth > 0) & (other > 0)
        observed = (depth[:, None] * first - other[:, None] * second)[kept]
        real = apart[kept]
        yaw = np.arctan2(real[:, 1], real[:, 0]) - np.arctan2(observed[:, 1], observed[:, 0])
        reach = (depth[:, None] * first)[kept]
        x = np.cos(yaw) * reach[:, 0] - np.sin(yaw) * reach[:, 1]
        y = np.sin(yaw) * reach[:, 0] + np.cos(yaw) * reach[:, 1]
        yaws.append(yaw)
        centers.append(points[kept, 0] - np.stack([x, y, reach[:, 2]], axis=1))
    return np.concatenate(yaws), np.concatenate(centers)


def _turned(level: Floats, yaw: float) -> Floats:
    """Returns cam_from_world of a camera at yaw 0 turned about the vertical."""
    c, s = np.cos(yaw), np.sin(yaw)
    back: NDArray[np.float64] = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(level @ back)


def _cost(near: Floats, pixels: Floats, camera: Camera, pose: Pose, limit_px: float) -> float:
    """Returns the sum of squared errors, each at most the limit's (MSAC)."""
    projected = camera.project((near - pose.center) @ pose.rotation.T)
    square = np.nan_to_num(((projected - pixels) ** 2).sum(axis=1), nan=np.inf)
    return float(np.minimum(square, limit_px**2).sum())
