"""A camera that is not as declared: against the camera model of geometry, and finite differences."""

import numpy as np
import pytest

from lodbench.estimation.lens import LensErrors, project, projection_slopes
from lodbench.geometry import Camera
from tests.town import CAMERA

ERRORS = LensErrors(focal=0.02, k1=-0.06, right=0.01, down=-0.02)
POINTS = np.random.default_rng(0).uniform([-20, -15, 30], [20, 15, 90], (40, 3))


def test_without_errors_it_is_the_pinhole():
    np.testing.assert_allclose(project(POINTS, CAMERA), CAMERA.project(POINTS), rtol=1e-12)


def test_errors_are_those_of_the_camera_model():
    pinhole = ERRORS.pinhole(CAMERA)
    sizes = pinhole.width, pinhole.height
    bent = Camera(*sizes, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, (ERRORS.k1, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(project(POINTS, CAMERA, ERRORS), bent.project(POINTS), rtol=1e-12)


def test_any_shape_of_points_will_do():
    grid = POINTS.reshape(4, 10, 3)
    np.testing.assert_array_equal(
        project(grid, CAMERA, ERRORS).reshape(-1, 2), project(POINTS, CAMERA, ERRORS)
    )


@pytest.mark.parametrize("errors", [LensErrors(), ERRORS])
def test_slopes_are_those_of_finite_differences(errors):
    numbers = np.array([0.0, 0.0, 0.0, errors.focal, errors.k1, errors.right, errors.down])

    def pixels(moved):
        return project(POINTS + moved[:3], CAMERA, LensErrors(*moved[3:]))

    steps = 1e-6 * np.eye(7)
    expected = np.stack([(pixels(numbers + s) - pixels(numbers - s)) / 2e-6 for s in steps], axis=2)
    slopes = projection_slopes(POINTS, CAMERA, errors)
    np.testing.assert_allclose(slopes, expected, rtol=1e-5, atol=1e-5)
