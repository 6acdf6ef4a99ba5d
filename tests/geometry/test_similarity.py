"""Similarities between frames, fitted to poses of which some are far off."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from lodbench.errors import LodbenchError
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.similarity import (
    SWISS_EPFL_FRAME,
    ShiftedEcef,
    Similarity,
    enu_from_ecef_rotation,
    fit_similarity,
    grid_convergence_deg,
)

SIGMAS = np.array([1.0, 1.0, 1.0])


def drawn(generator: np.random.Generator) -> Similarity:
    turn = Rotation.random(random_state=int(generator.integers(1 << 30))).as_matrix()
    return Similarity(float(np.exp(generator.uniform(-4, 4))), turn, generator.uniform(-1e6, 1e6, 3))


def poses(generator: np.random.Generator, count: int, *, is_straight: bool = False) -> list[Pose]:
    """Returns cameras of a flight, looking down and ahead, in a frame of their own."""
    centers = generator.uniform(-3, 3, (count, 3))
    if is_straight:
        centers = np.linspace(0, 1, count)[:, None] * np.array([[4.0, 1.0, 0.0]])
    angles = [EulerAngles(*generator.uniform((10, -2, -180), (60, 2, 180))) for _ in range(count)]
    return [Pose.from_euler(angle, center) for angle, center in zip(angles, centers, strict=True)]


@given(st.integers(0, 1 << 30), st.booleans())
def test_a_similarity_is_found_again_from_poses(seed, is_straight):
    generator = np.random.default_rng(seed)
    true, cameras = drawn(generator), poses(generator, 5, is_straight=is_straight)
    mapped = [true.pose(pose) for pose in cameras]
    reach = true.scale * 4.0
    fitted = fit_similarity(cameras, mapped, np.tile(SIGMAS * 0.01 * reach, (5, 1)), np.full(5, 1.0))
    assert fitted.similarity.scale == pytest.approx(true.scale, rel=1e-5)
    assert np.abs(fitted.similarity.rotation - true.rotation).max() < 1e-5
    assert fitted.distances_m.max() < 1e-4 * reach


def test_cameras_see_the_same_pixels_after_a_similarity():
    generator = np.random.default_rng(3)
    true, (camera,) = drawn(generator), poses(generator, 1)
    points = generator.uniform(-3, 3, (20, 3))
    before = points @ camera.rotation.T + camera.translation
    moved = true.pose(camera)
    after = true.points(points) @ moved.rotation.T + moved.translation
    # Depths grow with the scale, directions stay.
    assert after == pytest.approx(true.scale * before, rel=1e-6, abs=1e-6 * true.scale * 1e6)


def test_some_that_are_far_off_lead_nobody_astray():
    generator = np.random.default_rng(5)
    true, cameras = Similarity(30.0, np.eye(3), np.zeros(3)), poses(generator, 12)
    mapped = [true.pose(pose).shifted(generator.normal(0, 0.3, 3)) for pose in cameras]
    mapped[2] = mapped[2].shifted((150.0, -80.0, 20.0))
    mapped[7] = Pose.from_euler(EulerAngles(20, 0, 170), mapped[7].center)
    fitted = fit_similarity(cameras, mapped, np.full((12, 3), 0.3), np.full(12, 0.5))
    others = np.delete(fitted.distances_m, 2)
    assert np.median(others) < 0.8
    assert fitted.distances_m[2] > 100.0
    assert fitted.similarity.scale == pytest.approx(30.0, rel=0.01)


def test_the_sigmas_are_those_of_many_draws():
    generator = np.random.default_rng(8)
    true, cameras = Similarity(30.0, np.eye(3), np.zeros(3)), poses(generator, 10)
    exact = [true.pose(pose) for pose in cameras]
    middles, scales, told = [], [], []
    for _ in range(60):
        mapped = [pose.shifted(generator.normal(0, 0.5, 3)) for pose in exact]
        fitted = fit_similarity(cameras, mapped, np.full((10, 3), 0.5), np.full(10, 0.01))
        middles.append(fitted.middle)
        scales.append(fitted.similarity.scale / 30.0)
        told.append(fitted.sigmas)
    sigmas = np.mean(told, axis=0)
    assert np.std(middles, axis=0) == pytest.approx(sigmas[:3], rel=0.4)
    assert np.std(scales) == pytest.approx(sigmas[6], rel=0.4)


def test_what_leaves_the_scale_open_is_a_fault():
    generator = np.random.default_rng(1)
    two = poses(generator, 2)
    with pytest.raises(LodbenchError, match="at least 3 cameras"):
        fit_similarity(two, two, np.ones((2, 3)), np.ones(2))
    still = [pose.shifted(-pose.center) for pose in poses(generator, 4)]
    with pytest.raises(LodbenchError, match="one place"):
        fit_similarity(still, still, np.ones((4, 3)), np.ones(4))


_ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def test_up_at_the_swiss_origin():
    up = enu_from_ecef_rotation(SWISS_EPFL_FRAME.lat_deg, SWISS_EPFL_FRAME.lon_deg)[2]
    np.testing.assert_allclose(up, (0.6836, 0.0787, 0.7256), atol=5e-5)


@given(st.floats(-89, 89), st.floats(-180, 180))
def test_axes_are_those_of_the_ellipsoid(lat, lon):
    rotation = enu_from_ecef_rotation(lat, lon)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    low, high = (np.array(_ECEF.transform(lon, lat, h)) for h in (0.0, 1000.0))
    np.testing.assert_allclose(rotation @ (high - low), (0, 0, 1000), atol=1e-5)
    north = np.array(_ECEF.transform(lon, lat + 1e-5, 0.0)) - low
    assert (rotation @ north)[1] > 1.1
    assert abs((rotation @ north)[0]) < 1e-6


def test_points_turn_as_the_poses_do():
    frame = ShiftedEcef(lat_deg=46.5191, lon_deg=6.5668)
    pose = Pose.from_euler(EulerAngles(50.0, 3.0, 120.0), (100.0, -30.0, 250.0))
    points = np.random.default_rng(0).uniform(-200, 200, (7, 3))
    before = points @ pose.rotation.T + pose.translation
    turned = frame.pose_to_enu(pose)
    after = frame.points_to_enu(points) @ turned.rotation.T + turned.translation
    np.testing.assert_allclose(after, before, atol=1e-10)
    np.testing.assert_allclose(turned.center, frame.points_to_enu(pose.center[None])[0], atol=1e-10)


class TestConvergence:
    def test_at_the_uavd4l_site(self):
        assert grid_convergence_deg("EPSG:4547", 400242, 3131119) == pytest.approx(-0.48, abs=0.01)

    def test_none_on_the_central_meridian(self):
        assert grid_convergence_deg("EPSG:4547", 500000, 3131119) == pytest.approx(0.0, abs=1e-9)

    @pytest.mark.parametrize(
        ("crs", "east", "north"),
        [
            ("EPSG:25832", 280500, 5657500),
            ("EPSG:2056", 2.53e6, 1.15e6),
            ("EPSG:27572", 9.9e5, 1.84e6),  # Lambert II, in grads from Paris
            ("EPSG:29702", 5.1e5, 7.9e5),  # Laborde's, of Madagascar
        ],
    )
    def test_is_the_bearing_of_grid_north(self, crs, east, north):
        back = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
        (lon, lat), (lon2, lat2) = back.transform(east, north), back.transform(east, north + 100)
        bearing = np.degrees(np.arctan2((lon2 - lon) * np.cos(np.radians(lat)), lat2 - lat))
        # Grid north bears this much clockwise of true north; lengths of a degree differ by under 1 %.
        assert grid_convergence_deg(crs, east, north) == pytest.approx(bearing, rel=0.01)
