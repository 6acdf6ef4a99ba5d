"""Where cameras are put: a grid, a trajectory, around priors, at random."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.pose_text import read_poses
from lodbench.datasets.priors import UniformPrior
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.storage import random_stream
from lodbench.synthesis.surroundings.land import Plan
from lodbench.synthesis.surroundings.terrain_mesh import Ground
from lodbench.synthesis.training_data.params import TrainingParams
from lodbench.synthesis.view_sampling import view_of

Floats = NDArray[np.float64]

_YAWS_DEG = tuple(range(0, 360, 45))
# Random cameras look at a place about so far from a building (standard deviation).
_TARGET_SPREAD_M = 20.0


def picture_camera(params: TrainingParams) -> Camera:
    """Returns the camera of the pictures: square pixels, principal point in the middle."""
    width, height = params.size
    focal = 0.5 * width / math.tan(math.radians(0.5 * params.fov_deg))
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)


def candidates(params: TrainingParams, scene: Scene, plan: Plan, ground: Ground) -> list[Pose]:
    """Returns all poses that are asked for, in the scene's frame, before any is judged.

    Raises:
        DatasetError: The pose file cannot be read or is empty.
    """
    if params.sampling == "grid":
        return list(_on_grid(params, plan, ground))
    if params.sampling == "random":
        return [_at_random(params, plan, index) for index in range(params.count)]
    given = [pose.shifted(-scene.origin) for pose in read_poses(params.poses or "").values()]
    if not given:
        raise DatasetError(f"{params.poses} has no poses.", "Each line reads: name qw qx qy qz tx ty tz")
    if params.sampling == "priors":
        return list(_around(params, given))
    return list(_along(params, given))


def _on_grid(params: TrainingParams, plan: Plan, ground: Ground) -> Iterator[Pose]:
    """Yields the poses of a grid over the buildings, its spacing half the height, as UAVD4L has it."""
    low, high = plan.bases[:, :2].min(axis=0), plan.bases[:, :2].max(axis=0)
    yaws = params.yaw if params.yaw is not None else _YAWS_DEG
    for height in params.height:
        spacing = params.spacing_m or max(1.0, height // 2)
        axes = [_steps(low[k], high[k], spacing) for k in (0, 1)]
        places = np.stack([axis.ravel() for axis in np.meshgrid(*axes)], axis=1)
        centers = np.column_stack([places, ground.at(places) + height])
        for pitch in params.pitches_from_nadir():
            for center in centers:
                for yaw in yaws:
                    yield Pose.from_euler(EulerAngles(pitch, 0.0, float(yaw)), center)


def _steps(low: float, high: float, spacing: float) -> Floats:
    """Returns places from end to end, about a spacing apart; the middle if there is room for one."""
    number = max(1, round((high - low) / spacing))
    return np.linspace(low, high, number) if number > 1 else np.array([0.5 * (low + high)])


def _at_random(params: TrainingParams, plan: Plan, index: int) -> Pose:
    generator = random_stream(params.seed, "training", "camera", index)
    target = plan.bases[int(generator.integers(len(plan.bases)))].copy()
    target[:2] += generator.normal(0.0, _TARGET_SPREAD_M, size=2)
    pitches = params.pitches_from_nadir()
    # A camera that looks at the horizon sees its target from no height: keep the axis finite.
    pitch = min(85.0, pitches[int(generator.integers(len(pitches)))])
    height = params.height[int(generator.integers(len(params.height)))]
    return view_of(target, height, EulerAngles(pitch, 0.0, float(generator.uniform(-180.0, 180.0))))


def _around(params: TrainingParams, given: list[Pose]) -> Iterator[Pose]:
    errors = UniformPrior(*params.prior_m, *params.prior_deg)
    for number, pose in enumerate(given):
        for draw in range(params.count):
            yield errors.draw(pose, random_stream(params.seed, "training", "prior", number, draw))


def _along(params: TrainingParams, given: list[Pose]) -> Iterator[Pose]:
    """Yields poses along the straight lines between given centres, at these heights, looking ahead."""
    yaws = params.yaw if params.yaw is not None else (0.0,)
    centers = np.stack([pose.center for pose in given])
    for start, end in pairwise(centers):
        way = end - start
        length = float(np.hypot(way[0], way[1]))
        if length == 0.0:
            continue
        ahead = math.degrees(math.atan2(-way[0], way[1]))
        spacing = params.spacing_m or max(1.0, min(params.height) // 2)
        for share in np.arange(0.0, 1.0, min(1.0, spacing / length)):
            for pitch in params.pitches_from_nadir():
                for yaw in yaws:
                    yield Pose.from_euler(EulerAngles(pitch, 0.0, ahead + yaw), start + share * way)
