"""A laser's range: poses updated as the textbook has it, never less sure, and not led astray."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lodbench.citymap.laser import pose_by_range, range_log_densities
from lodbench.citymodel import open_scene
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.geometry.pose import vector_from_pose
from lodbench.photos.measurements import Measurements
from lodbench.photos.xmp import LaserRange
from lodbench.rendering.surfaces import Surfaces
from tests.town import box_obj

CAMERA = Camera(1000, 800, 900.0, 900.0, 500.0, 400.0)
# A wide flat roof, 20 m up, and others around that say where the ground is.
BOXES = [
    (-40, -40, 40, 40, 0, 20),
    (80, 80, 90, 90, 0, 9),
    (-90, 80, -80, 90, 0, 9),
    (80, -90, 90, -80, 0, 9),
]
DOWN = Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), (0.0, 0.0, 120.0))
MAP_M = 0.4


@pytest.fixture(scope="module")
def surfaces(tmp_path_factory) -> Surfaces:
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj(BOXES))
    return Surfaces(open_scene(path), MAP_M, 0.3)


def local(surfaces: Surfaces, pose: Pose) -> Pose:
    return pose.shifted(-surfaces.scene.origin)


@pytest.mark.parametrize("off_m", [-4.0, 0.5, 3.0])
def test_a_height_above_a_roof_moves_as_a_mean_of_two_measurements(surfaces, off_m):
    laser = LaserRange(100.0 + off_m, stated_sigma_m=0.3)
    covariance = np.diag([1.0, 1.0, 9.0, 1e-6, 1e-6, 1e-6])
    found = pose_by_range(surfaces, CAMERA, local(surfaces, DOWN), covariance, laser)
    # Two measurements of one height, of 3 m and of laser and roof: their weighted mean.
    ranged = 0.3**2 + MAP_M**2
    moved = found.vector - vector_from_pose(local(surfaces, DOWN))
    assert moved[2] == pytest.approx(off_m * 9.0 / (9.0 + ranged), rel=1e-6)
    assert np.abs(moved[[0, 1, 3, 4, 5]]).max() < 1e-3
    assert found.left_of(covariance)[2, 2] == pytest.approx(1.0 / (1.0 / 9.0 + 1.0 / ranged), rel=1e-6)
    assert "was used" in found.note


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), off_m=st.floats(-300.0, 300.0), tilt_deg=st.floats(0.0, 70.0))
def test_a_range_never_leaves_a_pose_less_sure(surfaces, seed, off_m, tilt_deg):
    draws = np.random.default_rng(seed)
    mixed = draws.normal(size=(6, 6)) * np.array([2.0, 2.0, 4.0, 0.4, 0.4, 2.0])[:, None]
    covariance = mixed @ mixed.T + 1e-6 * np.eye(6)
    pose = Pose.from_euler(EulerAngles(tilt_deg, 0.0, 30.0), (5.0, -20.0, 110.0))
    laser = LaserRange(max(1.0, 120.0 + off_m))
    found = pose_by_range(surfaces, CAMERA, local(surfaces, pose), covariance, laser)
    gained = np.linalg.eigvalsh(covariance - found.left_of(covariance))
    assert gained.min() > -1e-7 * np.trace(covariance)
    if found.kept is None:
        assert "not used" in found.note
        np.testing.assert_array_equal(found.vector, vector_from_pose(local(surfaces, pose)))


@pytest.mark.parametrize("range_m", [30.0, 800.0])
def test_a_wildly_wrong_range_is_contradicted_aloud_and_not_followed(surfaces, range_m):
    covariance = np.diag([1.0, 1.0, 9.0, 0.1, 0.1, 1.0])
    found = pose_by_range(surfaces, CAMERA, local(surfaces, DOWN), covariance, LaserRange(range_m))
    assert f"measured {range_m:.1f} m" in found.note
    assert "sigma apart: not used" in found.note
    np.testing.assert_array_equal(found.left_of(covariance), covariance)


def test_a_range_that_may_be_to_roof_or_ground_moves_nothing(surfaces):
    # A metre inside the roof's edge, with a place known to three: 110 m fit neither, or both with a height.
    edge = Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), (39.0, 0.0, 120.0))
    covariance = np.diag([9.0, 9.0, 36.0, 1e-6, 1e-6, 1e-6])
    found = pose_by_range(surfaces, CAMERA, local(surfaces, edge), covariance, LaserRange(110.0))
    assert "one of two surfaces" in found.note
    assert found.kept is None
    plain = pose_by_range(surfaces, CAMERA, local(surfaces, edge), covariance, LaserRange(100.5))
    assert "to the roof was used" in plain.note


def test_the_sky_contradicts_nothing(surfaces):
    up = Pose.from_euler(EulerAngles(150.0, 0.0, 0.0), (0.0, 0.0, 120.0))
    found = pose_by_range(surfaces, CAMERA, local(surfaces, up), np.eye(6) * 1e-4, LaserRange(90.0))
    assert "show no surface: not used" in found.note


def test_densities_of_rough_poses_are_those_of_a_mixture(surfaces):
    laser = LaserRange(101.0, stated_sigma_m=0.3)
    query = SimpleNamespace(measured=Measurements(laser=laser), camera=CAMERA)
    heights = np.array([120.0, 121.0, 125.0, 160.0])
    poses = [local(surfaces, DOWN).shifted([0.0, 0.0, z - 120.0]) for z in heights]
    found = range_log_densities(
        query, SimpleNamespace(surfaces=surfaces), np.array([*map(vector_from_pose, poses)])
    )
    sigma = math.sqrt(0.3**2 + MAP_M**2 + 2.0**2)
    for z, value in zip(heights, found, strict=True):
        normal = math.exp(-0.5 * ((z - 20.0 - 101.0) / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
        assert value == pytest.approx(math.log(0.9 * normal + 0.1 / 200.0))
    nothing = SimpleNamespace(measured=None, camera=CAMERA)
    assert not range_log_densities(nothing, SimpleNamespace(surfaces=surfaces), np.zeros((3, 6))).any()
