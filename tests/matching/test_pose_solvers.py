"""Pose solvers: on correspondences whose pose is known, among outliers, far from zero, and where none is."""

import sys

import numpy as np
import pytest

from lodbench.errors import ConfigError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.matching.pose_solver import open_pose_solver, poses_of_pairs

CAMERA = Camera(1204, 896, 861.6, 853.3, 607.4, 434.8)
NAMES = ["opencv", "poselib", "pycolmap", "upright"]


def correspondences(seed: int, outliers: float, origin=(0.0, 0.0, 0.0), count: int = 500):
    stream = np.random.default_rng(seed)
    angles = EulerAngles(stream.uniform(20, 60), 0.4, stream.uniform(-180, 180))
    pose = Pose.from_euler(angles, np.array([3.0, -7.0, 130.0]) + origin)
    pixels = stream.uniform(size=(count, 2)) * (CAMERA.width, CAMERA.height)
    rays = np.c_[(pixels - (CAMERA.cx, CAMERA.cy)) / (CAMERA.fx, CAMERA.fy), np.ones(count)]
    points = (rays * stream.uniform(100, 260, (count, 1))) @ pose.rotation + pose.center
    seen = pixels + stream.normal(scale=1.0, size=pixels.shape)
    wrong = np.arange(count) < outliers * count
    seen[wrong] = stream.uniform(size=(int(wrong.sum()), 2)) * (CAMERA.width, CAMERA.height)
    return pose, points, seen, wrong


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.8])
def test_the_pose_is_found_among_outliers(name, outliers):
    for seed in range(4):
        pose, points, pixels, wrong = correspondences(seed, outliers)
        found = open_pose_solver(name).solve(points, pixels, CAMERA, pose)
        assert np.linalg.norm(found.pose.center - pose.center) < 0.5
        assert found.inliers[~wrong].mean() > 0.98
        assert found.inliers[wrong].mean() < 0.05 if wrong.any() else True


def test_gravity_helps_where_nearly_all_is_wrong_though_it_is_a_little_off():
    for seed in range(4):
        pose, points, pixels, _ = correspondences(seed, 0.95)
        pitch, roll, yaw = pose.euler
        prior = Pose.from_euler(EulerAngles(pitch + 0.3, roll - 0.3, yaw + 40), pose.center + 30.0)
        found = open_pose_solver("upright").solve(points, pixels, CAMERA, prior)
        assert np.linalg.norm(found.pose.center - pose.center) < 0.5


def test_two_points_and_gravity_give_the_pose_they_are_seen_from():
    pose, points, _, _ = correspondences(0, 0.0)
    yaw = np.radians(33.0)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    rays = (points - pose.center) @ turn * np.random.default_rng(0).uniform(0.01, 3, (len(points), 1))
    pairs = np.arange(400).reshape(-1, 2)
    yaws, centers = poses_of_pairs(points[pairs], rays[pairs])
    is_it = np.linalg.norm(centers - pose.center, axis=1) < 1e-6
    # One of the two poses of every pair.
    assert is_it.sum() == len(pairs)
    assert np.abs(np.angle(np.exp(1j * (yaws[is_it] - yaw)))).max() < 1e-9


@pytest.mark.parametrize("name", NAMES)
def test_points_far_from_zero_lose_nothing(name):
    pose, points, pixels, _ = correspondences(1, 0.3, origin=(691_000.0, 5_335_000.0, 500.0))
    found = open_pose_solver(name).solve(points, pixels, CAMERA, pose)
    assert np.linalg.norm(found.pose.center - pose.center) < 0.5


@pytest.mark.parametrize("name", NAMES)
def test_a_tighter_threshold_leaves_fewer(name):
    pose, points, pixels, _ = correspondences(2, 0.2)
    loose = open_pose_solver(name, threshold_px=8.0).solve(points, pixels, CAMERA, pose)
    tight = open_pose_solver(name, threshold_px=0.8).solve(points, pixels, CAMERA, pose)
    assert tight.inliers.sum() < 0.7 * loose.inliers.sum()


@pytest.mark.parametrize("name", NAMES)
def test_nothing_to_agree_on_is_none_or_few(name):
    pose, points, pixels, _ = correspondences(3, 1.0, count=60)
    found = open_pose_solver(name).solve(points, pixels, CAMERA, pose)
    assert found is None or found.inliers.sum() < 12
    assert open_pose_solver(name).solve(points[:3], pixels[:3], CAMERA, pose) is None


@pytest.mark.parametrize("name", ["poselib", "pycolmap"])
def test_an_absent_library_is_told_in_a_line(name, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=f"needs {name}") as raised:
        open_pose_solver(name)
    assert "lodbench[pnp]" in raised.value.hint


@pytest.mark.parametrize("wrong", [{"threshold_px": 0.0}, {"max_iterations": 0}, {"confidence": 1.0}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ConfigError):
        open_pose_solver("opencv", **wrong)
