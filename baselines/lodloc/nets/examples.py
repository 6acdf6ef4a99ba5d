"""What a view teaches: poses around its truth, drawn anew each time, and the losses on them."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from lodbench.geometry import EulerAngles, Pose, rotations_at_yaws

from ..training_params import LodLocTraining
from ..training_views import TrainingView
from .losses import refinement_loss, selection_loss

# Of each stage: size of its map, half widths of what is drawn (x, y, z in metres, yaw in degrees), weight.
STAGES = (
    (0.25, (10.0, 10.0, 30.0, 7.5), 0.5),
    (0.5, (3.0, 3.0, 9.0, 2.5), 1.0),
    (1.0, (1.0, 1.0, 3.0, 0.8), 1.5),
)
# Standard deviations where refinement starts: metres, and degrees of pitch, roll and yaw.
_START_M, _START_DEG = 0.8, (0.6, 0.6, 0.4)
_REFINEMENT_WEIGHT, _STEPS = 0.25, 3
# Share of a stage's widths that half of its poses are drawn from: those that are hard to tell from the truth.
_NEAR = 0.3


def losses_of(
    packed: tuple[Tensor, ...], view: TrainingView, settings: LodLocTraining, draw: np.random.Generator
) -> dict[str, Tensor]:
    """Returns the weighted losses of one view by name.

    Args:
        packed: The four maps (1, h, w) of its photo, padding included.
        view: Its truth and rough poses.
        settings: How many poses and points.
        draw: All that is drawn by chance.
    """
    camera = view.camera
    maps = [
        values[0, : math.ceil(scale * camera.height), : math.ceil(scale * camera.width)]
        for scale, values in zip((0.25, 0.5, 1.0, 1.0), packed, strict=True)
    ]
    which = int(draw.integers(len(view.priors)))
    wireframe = view.wireframes[which]
    taken = draw.choice(len(wireframe), min(settings.points, len(wireframe)), replace=False)
    points = torch.from_numpy(wireframe[taken])
    intrinsics = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float32)
    losses = {}
    for number, (scale, widths, weight) in enumerate(STAGES):
        # The grid's tilt is the sensor's; once the range is narrow, what tilt costs is mostly made up for.
        tilt = view.priors[which] if number == 0 else view.truth
        poses = _poses_near(view.truth, tilt, np.array(widths), settings.poses, draw)
        losses[f"stage {number + 1}"] = weight * selection_loss(
            maps[number], scale, points, *poses, intrinsics
        )
    truth = _tensors(view.truth.rotation, np.zeros(3))
    ended = refinement_loss(maps[3], points, _start(view.truth, draw), truth, intrinsics, _STEPS)
    return losses | {"refinement": _REFINEMENT_WEIGHT * ended}


def _poses_near(
    truth: Pose, tilt: Pose, widths: np.ndarray, count: int, draw: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Returns rotations (K, 3, 3) and centres (K, 3), less the true one: first the truth's, at a tilt.

    Of the others half fill a box in which the truth lies anywhere, half are near the truth.
    """
    middle = draw.uniform(-1.0, 1.0, 4) * widths
    offsets = middle + draw.uniform(-1.0, 1.0, (count, 4)) * widths
    offsets[: count // 2] = draw.uniform(-_NEAR, _NEAR, (count // 2, 4)) * widths
    offsets[0] = 0.0
    pitch_deg, roll_deg, _ = tilt.euler
    return _tensors(
        rotations_at_yaws(pitch_deg, roll_deg, truth.euler.yaw_deg + offsets[:, 3]), offsets[:, :3]
    )


def _start(truth: Pose, draw: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Returns rotation and centre, less the true one, where refinement starts."""
    turned = EulerAngles(*(np.array(truth.euler) + draw.normal(0.0, 1.0, 3) * _START_DEG))
    start = Pose.from_euler(turned, draw.normal(0.0, _START_M, 3))
    return _tensors(start.rotation, start.center)


def _tensors(rotations: np.ndarray, centers: np.ndarray) -> tuple[Tensor, Tensor]:
    return (
        torch.from_numpy(np.ascontiguousarray(rotations, dtype=np.float32)),
        torch.from_numpy(np.ascontiguousarray(centers, dtype=np.float32)),
    )
