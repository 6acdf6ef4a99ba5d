import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Transformer

from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.similarity import (
    SWISS_EPFL_FRAME,
    ShiftedEcef,
    enu_from_ecef_rotation,
    grid_convergence_deg,
)

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
