"""The cost volume: how well a wireframe fits at each pose of a 4D grid, narrowed stage by stage."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lodbench.geometry import AxisRange, Camera, Pose, PoseGrid, rotations_at_yaws

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
# Nearer than this nothing is projected, metres.
NEAR_M = 1.0


class Stage(NamedTuple):
    """What a stage found.

    Attributes:
        pose: The best pose of its grid.
        score: Its mean log-likelihood.
        deviations: Standard deviations around it in x, y, z (metres) and yaw (degrees).
    """

    pose: Pose
    score: float
    deviations: Floats


def search_grid(
    values: Singles, scale: float, camera: Camera, points: Floats, start: Pose, grid: PoseGrid
) -> Stage:
    """Returns the best pose of a grid, and how sure it is of it.

    Args:
        values: (h, w) map of log-likelihoods.
        scale: Its size over the camera's.
        camera: Pinhole at the working size.
        points: (N, 3) of the wireframe, scene metres.
        start: The grid's middle; its tilt is every pose's.
        grid: Ranges and counts.
    """
    centers, yaws = grid.around(start)
    per_yaw = len(centers) // grid.yaw.count
    rotations = rotations_at_yaws(start.euler.pitch_deg, start.euler.roll_deg, yaws[::per_yaw])
    moves = centers[:per_yaw] - start.center
    scores = volume_scores(values, scale, camera, points - start.center, rotations, moves)
    best = int(np.argmax(scores))
    pose = Pose.from_center(rotations[best // per_yaw], centers[best])
    return Stage(pose, float(scores.flat[best]), _deviations(scores.ravel(), best, centers, yaws))


def volume_scores(
    values: Singles, scale: float, camera: Camera, points: Floats, rotations: Floats, centers: Floats
) -> Floats:
    """Returns (Y, M) mean log-likelihoods of points at Y rotations x M centres; places outside count 0."""
    turned = np.ascontiguousarray((points @ rotations.transpose(0, 2, 1)).astype(np.float32))
    moved = np.ascontiguousarray((centers @ rotations.transpose(0, 2, 1)).astype(np.float32))
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float32) * np.float32(scale)
    # Map columns count from the middle of the first pixel.
    intrinsics[2:] -= np.float32(0.5)
    return np.asarray(_volume(_framed(values), turned, moved, intrinsics), dtype=np.float64)


def _framed(values: Singles) -> Singles:
    """Returns a map with a rim of zeros, so that what lies across its border fades out."""
    return np.pad(values, 1)


@njit(cache=True, nogil=True, error_model="numpy")
def _volume(framed, turned, moved, f):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns (Y, M) sums over points / N; ``framed`` is a map with a rim of one."""
    yaws, count = turned.shape[0], turned.shape[1]
    poses = moved.shape[1]
    rows, columns = framed.shape
    scores = np.zeros((yaws, poses), dtype=np.float32)
    for yaw in range(yaws):
        for pose in range(poses):
            x0, y0, z0 = moved[yaw, pose, 0], moved[yaw, pose, 1], moved[yaw, pose, 2]
            total = np.float32(0.0)
            for k in range(count):
                z = turned[yaw, k, 2] - z0
                if z < np.float32(NEAR_M):
                    continue
                u = f[0] * (turned[yaw, k, 0] - x0) / z + f[2] + np.float32(1.0)
                v = f[1] * (turned[yaw, k, 1] - y0) / z + f[3] + np.float32(1.0)
                if not (u >= 0 and v >= 0 and u < columns - 1 and v < rows - 1):
                    continue
                i, j = int(v), int(u)
                across, down = u - np.float32(j), v - np.float32(i)
                above = framed[i, j] + across * (framed[i, j + 1] - framed[i, j])
                below = framed[i + 1, j] + across * (framed[i + 1, j + 1] - framed[i + 1, j])
                total += above + down * (below - above)
            scores[yaw, pose] = total / np.float32(count)
    return scores


def _deviations(scores: Floats, best: int, centers: Floats, yaws_deg: Floats) -> Floats:
    """Returns the root mean square distance from the best pose, under the softmax of the scores."""
    share = np.exp(scores - scores[best])
    share /= share.sum()
    offsets = np.column_stack([centers - centers[best], yaws_deg - yaws_deg[best]])
    return np.asarray(np.sqrt(share @ offsets**2))


def narrowed(grid: PoseGrid, deviations: Floats, spread: float) -> PoseGrid:
    """Returns a grid of as many samples whose half widths are so many deviations.

    Never wider than the grid, nor narrower than its step, each way: the truth lies between two samples.
    """

    def axis(old: AxisRange, deviation: float) -> AxisRange:
        least = 2.0 * old.width / max(1, old.count - 1)
        return AxisRange(min(old.width, max(2.0 * spread * deviation, least)), old.count)

    x, y, z, yaw = (float(each) for each in deviations)
    return PoseGrid(axis(grid.x, x), axis(grid.y, y), axis(grid.z, z), axis(grid.yaw, yaw))
