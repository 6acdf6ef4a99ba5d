"""Errors and recalls against computations that share no code with ours."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lodbench.datasets.pose_text import format_pose
from lodbench.evaluation import pose_error, summarize
from lodbench.evaluation.errors import FAILED, error_parts
from lodbench.geometry import EulerAngles, Pose


def poses(count: int, seed: int) -> list[Pose]:
    generator = np.random.default_rng(seed)
    return [
        Pose.from_euler(
            EulerAngles(*generator.uniform((20, -2, -180), (60, 2, 180))), generator.uniform(-500, 500, 3)
        )
        for _ in range(count)
    ]


def disturbed(truth: Pose, generator: np.random.Generator) -> Pose:
    pitch, roll, yaw = truth.euler
    turn = generator.normal(0, 1.5, 3)
    return Pose.from_euler(
        EulerAngles(pitch + turn[0], roll + turn[1], yaw + turn[2]), truth.center + generator.normal(0, 2, 3)
    )


def test_a_slow_reading_of_the_text_gives_the_same_table():
    """From the text lines alone: scipy's rotations, arccos of the trace, counting by hand."""
    generator = np.random.default_rng(8)
    truths = poses(50, 1)
    estimates = [disturbed(truth, generator) for truth in truths]
    fast = summarize([pose_error(e, t) for e, t in zip(estimates, truths, strict=True)] + [FAILED] * 3)
    distances, angles = [], []
    for estimate, truth in zip(estimates, truths, strict=True):
        rows = [[float(word) for word in format_pose("q", pose).split()[1:]] for pose in (estimate, truth)]
        (r1, c1), (r2, c2) = (
            (r, -r.T @ np.array(t)) for r, t in ((matrix(row[:4]), row[4:]) for row in rows)
        )
        distances.append(math.sqrt(sum((a - b) ** 2 for a, b in zip(c1, c2, strict=True))))
        angles.append(math.degrees(math.acos(min(1.0, (np.trace(r2.T @ r1) - 1) / 2))))
    distances += [math.inf] * 3
    angles += [180.0] * 3
    for metres, degrees in ((2, 2), (3, 3), (5, 5)):
        found = sum(d < metres and a < degrees for d, a in zip(distances, angles, strict=True))
        assert fast.recall[f"{metres}m-{degrees}deg"] == pytest.approx(100 * found / 53)
    assert fast.median_translation_m == pytest.approx(sorted(distances)[26])
    assert fast.median_rotation_deg == pytest.approx(sorted(angles)[26], abs=1e-5)


def matrix(quat_wxyz: list[float]) -> np.ndarray:
    w, x, y, z = quat_wxyz
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def test_evo_agrees_on_the_translation_errors_of_a_trajectory(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    metrics = pytest.importorskip("evo.core.metrics")
    generator = np.random.default_rng(4)
    truths = poses(30, 2)
    estimates = [disturbed(truth, generator) for truth in truths]
    trajectories = []
    for name, trajectory in (("truth", truths), ("estimate", estimates)):
        path = tmp_path / f"{name}.tum"
        path.write_text("".join(tum_line(i, pose) for i, pose in enumerate(trajectory)))
        trajectories.append(file_interface.read_tum_trajectory_file(str(path)))
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(tuple(trajectories))
    ours = [pose_error(e, t).translation_m for e, t in zip(estimates, truths, strict=True)]
    np.testing.assert_allclose(ours, ape.error, atol=1e-7)
    turns = metrics.APE(metrics.PoseRelation.rotation_angle_deg)
    turns.process_data(tuple(trajectories))
    ours = [pose_error(e, t).rotation_deg for e, t in zip(estimates, truths, strict=True)]
    np.testing.assert_allclose(ours, turns.error, atol=1e-5)


def tum_line(time: int, pose: Pose) -> str:
    w, x, y, z = pose.quat_wxyz
    center = " ".join(repr(float(v)) for v in pose.center)
    return f"{time} {center} {-x!r} {-y!r} {-z!r} {w!r}\n"


def test_parts_make_up_the_whole():
    generator = np.random.default_rng(9)
    for truth in poses(20, 3):
        estimate = disturbed(truth, generator)
        parts, whole = error_parts(estimate, truth), pose_error(estimate, truth)
        assert math.hypot(parts.horizontal_m, parts.vertical_m) == pytest.approx(whole.translation_m)
