"""Gauss-Newton on the pose, all six degrees of it: the wireframe's points to where a map is 0."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from lodbench.geometry import Camera, Pose

from .cost_volume import NEAR_M

Floats = NDArray[np.float64]
# Of differences of the map, pixels; and the damping: a share of the diagonal, and a floor.
_STEP_PX, _DAMPING, _FLOOR = 1.0, 0.01, 1e-4
# Points nearer to the rim than this say nothing of a gradient, pixels.
_RIM_PX = 4.0
# Fewer points than this do not hold six numbers.
_LEAST_POINTS = 12


def refined(
    values: NDArray[np.float32], camera: Camera, points: Floats, start: Pose, iterations: int
) -> Pose:
    """Returns the pose after some damped Gauss-Newton steps on the sum of a map's squares.

    Args:
        values: (H, W) map that is 0 on the wireframe.
        camera: Pinhole of the map's size.
        points: (N, 3) scene metres.
        start: Where to start.
        iterations: How many steps.
    """
    pose = start
    for _ in range(iterations):
        in_camera = (points - pose.center) @ pose.rotation.T
        in_camera = in_camera[in_camera[:, 2] > NEAR_M]
        pixels = camera.project(in_camera)
        size = np.array([camera.width, camera.height])
        is_inside = ((pixels > _RIM_PX) & (pixels < size - _RIM_PX)).all(axis=1)
        if is_inside.sum() < _LEAST_POINTS:
            return pose
        value, slope = _value_and_slope(values, pixels[is_inside])
        pose = _moved(pose, _step(value, _jacobian(slope, in_camera[is_inside], camera)))
    return pose


def _value_and_slope(values: NDArray[np.float32], pixels: Floats) -> tuple[Floats, Floats]:
    """Returns a map's values (N,) and slopes (N, 2) per pixel across and down, at COLMAP pixels."""

    def at(across: float, down: float) -> Floats:
        rows, columns = pixels[:, 1] - 0.5 + down, pixels[:, 0] - 0.5 + across
        return np.asarray(map_coordinates(values, [rows, columns], order=1, output=np.float64))

    slope = [at(_STEP_PX, 0.0) - at(-_STEP_PX, 0.0), at(0.0, _STEP_PX) - at(0.0, -_STEP_PX)]
    return at(0.0, 0.0), np.stack(slope, axis=1) / (2.0 * _STEP_PX)


def _jacobian(slope: Floats, in_camera: Floats, camera: Camera) -> Floats:
    """Returns (N, 6): change of the map per turn (rad) and move (m), camera axes."""
    x, y, z = in_camera.T
    by_x, by_y = slope[:, 0] * camera.fx / z, slope[:, 1] * camera.fy / z
    by_place = np.stack([by_x, by_y, -(by_x * x + by_y * y) / z], axis=1)
    return np.hstack([np.cross(in_camera, by_place), by_place])


def _step(value: Floats, jacobian: Floats) -> Floats:
    normal = jacobian.T @ jacobian
    damped = normal + np.diag(np.diagonal(normal) * _DAMPING + _FLOOR)
    return np.asarray(np.linalg.solve(damped, -(jacobian.T @ value)))


def _moved(pose: Pose, delta: Floats) -> Pose:
    """Returns a pose turned and moved in camera axes: places there become turn p + move."""
    turned = Rotation.from_rotvec(delta[:3]).as_matrix() @ pose.rotation
    return Pose.from_center(turned, pose.center - turned.T @ delta[3:])
