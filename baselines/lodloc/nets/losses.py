"""What the maps are trained by: the true pose among others, and where refinement ends."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

# Central differences of the refinement's map, pixels, and its damping (as the facts of the released code).
_STEP_PX, _DAMPING, _FLOOR = 1.0, 0.01, 1e-4
_LEAST_DEPTH_M = 1.0
# Points nearer to the rim than this say nothing of a gradient, pixels.
_RIM_PX = 4.0
# Scale of the robust loss, pixels, and where a point's loss ends.
_SCALE_PX, _MOST = 2.0, 5.0


def projected(
    points: Tensor, rotations: Tensor, centers: Tensor, intrinsics: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns pixels (K, N, 2) of points (N, 3) at K poses, and their places (K, N, 3) in camera axes."""
    in_camera = (points[None] - centers[:, None]) @ rotations.transpose(1, 2)
    depth = in_camera[..., 2:].clamp_min(_LEAST_DEPTH_M)
    return in_camera[..., :2] / depth * intrinsics[:2] + intrinsics[2:], in_camera


def sampled(values: Tensor, pixels: Tensor, scale: float) -> Tensor:
    """Returns (K, N) of a map (h, w) at pixels (K, N, 2) of the full size, bilinear; 0 outside."""
    height, width = values.shape
    size = torch.tensor([width, height], dtype=pixels.dtype)
    grid = pixels * (2.0 * scale / size) - 1.0
    return functional.grid_sample(values[None, None], grid[None], padding_mode="zeros", align_corners=False)[
        0, 0
    ]


def selection_loss(
    values: Tensor, scale: float, points: Tensor, rotations: Tensor, centers: Tensor, intrinsics: Tensor
) -> Tensor:
    """Returns minus the log of the first pose's share, among K poses, of the softmax of mean likelihoods."""
    with torch.no_grad():
        pixels, in_camera = projected(points, rotations, centers, intrinsics)
        is_ahead = (in_camera[..., 2] > _LEAST_DEPTH_M).to(pixels.dtype)
    scores = (sampled(values, pixels, scale) * is_ahead).mean(dim=1)
    return torch.logsumexp(scores, dim=0) - scores[0]


def refinement_loss(
    values: Tensor,
    points: Tensor,
    start: tuple[Tensor, Tensor],
    truth: tuple[Tensor, Tensor],
    intrinsics: Tensor,
    steps: int,
) -> Tensor:
    """Returns the mean robust reprojection error after each of some Gauss-Newton steps.

    Args:
        values: (H, W) map that vanishes on the wireframe.
        points: (N, 3).
        start: Rotation (3, 3) cam_from_world and centre (3,) to start from.
        truth: Those of the true pose.
        intrinsics: fx, fy, cx, cy.
        steps: How many; each starts where the one before ended, without its gradient.
    """
    wanted, wanted_in_camera = projected(points, truth[0][None], truth[1][None], intrinsics)
    is_visible = _is_inside(wanted[0], values) & (wanted_in_camera[0, :, 2] > _LEAST_DEPTH_M)
    if int(is_visible.sum()) < 12:
        return values.sum() * 0.0
    losses = []
    rotation, center = start
    for _ in range(steps):
        rotation, center = _step(values, points, rotation.detach(), center.detach(), intrinsics)
        reprojected, _ = projected(points[is_visible], rotation[None], center[None], intrinsics)
        squared = ((reprojected[0] - wanted[0, is_visible]) ** 2).sum(dim=1)
        # Barron's general loss with alpha = 1.
        robust = torch.sqrt(squared / _SCALE_PX**2 + 1.0) - 1.0
        losses.append(robust.clamp_max(_MOST).mean())
    return torch.stack(losses).mean()


def _is_inside(pixels: Tensor, values: Tensor) -> Tensor:
    height, width = values.shape
    across, down = pixels[..., 0], pixels[..., 1]
    return (across > _RIM_PX) & (down > _RIM_PX) & (across < width - _RIM_PX) & (down < height - _RIM_PX)


def _step(
    values: Tensor, points: Tensor, rotation: Tensor, center: Tensor, intrinsics: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns the pose after one damped Gauss-Newton step that drives a map to 0 on the points."""
    pixels, in_camera = projected(points, rotation[None], center[None], intrinsics)
    weight = (_is_inside(pixels[0], values) & (in_camera[0, :, 2] > _LEAST_DEPTH_M)).to(values.dtype)
    across = torch.tensor([_STEP_PX, 0.0])
    down = torch.tensor([0.0, _STEP_PX])
    places = torch.cat([pixels, pixels + across, pixels - across, pixels + down, pixels - down])
    value, right, left, below, above = sampled(values, places, 1.0)
    slope = torch.stack([right - left, below - above], dim=1) / (2.0 * _STEP_PX)
    jacobian = pose_jacobian(slope, in_camera[0], intrinsics) * weight[:, None]
    normal = jacobian.T @ jacobian
    damped = normal + torch.diag(torch.diagonal(normal) * _DAMPING + _FLOOR)
    delta = torch.linalg.solve(damped, -(jacobian.T @ (value * weight)))
    turn = torch.linalg.matrix_exp(_skew(delta[:3]))
    turned = turn @ rotation
    # p' = turn p + move in camera axes: the centre moves against it.
    return turned, center - turned.T @ delta[3:]


def pose_jacobian(slope: Tensor, in_camera: Tensor, intrinsics: Tensor) -> Tensor:
    """Returns (N, 6): change of a map's value per turn (rad, camera axes) and move (m, camera axes)."""
    x, y, z = in_camera.unbind(dim=1)
    z = z.clamp_min(_LEAST_DEPTH_M)
    by_x, by_y = slope[:, 0] * intrinsics[0] / z, slope[:, 1] * intrinsics[1] / z
    by_z = -(by_x * x + by_y * y) / z
    by_place = torch.stack([by_x, by_y, by_z], dim=1)
    return torch.cat([torch.linalg.cross(in_camera, by_place, dim=1), by_place], dim=1)


def _skew(vector: Tensor) -> Tensor:
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
