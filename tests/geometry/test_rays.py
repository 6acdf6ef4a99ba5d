"""Rays through pixels: back through every lens, and how pixels move with a camera's parameters."""

from dataclasses import replace

import numpy as np
import pytest

from lodbench.errors import ConfigError
from lodbench.geometry import Camera, EulerAngles, rotation_from_euler
from lodbench.geometry.angles import turning_axes
from lodbench.geometry.camera import CAMERA_PARAMETERS, camera_columns, pixel_rays
from tests.geometry.test_lens import MODELS


@pytest.fixture(scope="module")
def points():
    xy = np.random.default_rng(5).uniform(-0.6, 0.6, (50, 2))
    return np.column_stack([np.vstack([xy, [[0.0, 0.0]]]), np.ones(51)])


@pytest.mark.parametrize("model", MODELS)
def test_a_ray_goes_back_where_its_pixel_came_from(model, points):
    camera = Camera.from_colmap(model, 640, 512, MODELS[model])
    rays = pixel_rays(camera, camera.project(points))
    np.testing.assert_allclose(rays.directions, points, atol=1e-8)
    for axis in range(2):
        step = 1e-5 * np.eye(3)[axis]
        moved = (camera.project(points + step) - camera.project(points - step)) / 2e-5
        np.testing.assert_allclose(rays.pixel_by_point[:, :, axis], moved, atol=1e-3)
    unit = rays.pixel_by_point @ rays.point_by_pixel
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(2), unit.shape), atol=1e-9)


def test_no_ray_comes_from_beyond_where_a_lens_folds():
    camera = Camera.from_colmap("SIMPLE_RADIAL", 1000, 1000, (500.0, 500.0, 500.0, -0.4))
    directions = pixel_rays(camera, np.array([[500.0, 600.0], [999.0, 999.0]])).directions
    assert np.isfinite(directions[0]).all()
    assert np.isnan(directions[1, :2]).all()


def test_pixels_move_with_the_camera_as_their_projections_do(points):
    camera = Camera.from_colmap("OPENCV", 640, 512, MODELS["OPENCV"])
    names = tuple(CAMERA_PARAMETERS)

    def moved(name: str, by: float) -> Camera:
        if name == "focal":
            return replace(camera, fx=camera.fx * (1 + by), fy=camera.fy * (1 + by))
        if name == "k1":
            return replace(camera, distortion=(camera.distortion[0] + by, *camera.distortion[1:]))
        return replace(camera, **{name: getattr(camera, name) + by})

    found = camera_columns(camera, pixel_rays(camera, camera.project(points)), names)
    for column, name in enumerate(names):
        ahead, behind = (moved(name, by).project(points) for by in (1e-5, -1e-5))
        np.testing.assert_allclose(found[:, :, column], (ahead - behind) / 2e-5, atol=1e-3)
    assert camera_columns(camera, pixel_rays(camera, np.ones((3, 2))), ()).shape == (3, 2, 0)
    with pytest.raises(ConfigError, match="parameters=k2"):
        camera_columns(camera, pixel_rays(camera, np.ones((3, 2))), ["k2"])


@pytest.mark.parametrize("angles", [(0, 0, 0), (35, 2, -70), (88, -6, 179)])
def test_a_camera_turns_about_its_turning_axes(angles):
    ahead = np.array([0.3, -0.2, 1.0])
    axes = turning_axes(EulerAngles(*angles))
    for k in range(3):
        step = 1e-4 * np.eye(3)[k]
        one, other = (rotation_from_euler(EulerAngles(*(angles + s))) for s in (step, -step))
        changed = ahead @ (one - other) / np.radians(2e-4)
        np.testing.assert_allclose(
            np.cross(axes[k], ahead @ rotation_from_euler(EulerAngles(*angles))), changed, atol=1e-7
        )
