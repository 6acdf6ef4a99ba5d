import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.errors import LodbenchError
from lodbench.geometry import Camera

RGB = Camera(5280, 3956, 3778.423, 3767.392, 2663.624, 1919.721)


class TestScaling:
    def test_the_published_working_camera(self):
        # Figures printed with the digits given; the full-size ones are rounded to a thousandth.
        camera = RGB.scaled(602, 448)
        assert (camera.width, camera.height) == (602, 448)
        assert camera.fx == pytest.approx(430.79748, abs=1e-4)
        assert camera.fy == pytest.approx(426.64093, abs=1e-4)
        assert camera.cx == pytest.approx(303.69349, abs=1e-4)
        assert camera.cy == pytest.approx(217.400193, abs=1e-4)

    @given(st.integers(1, 4000), st.integers(1, 4000))
    def test_there_and_back(self, width, height):
        again = RGB.scaled(width, height).scaled(RGB.width, RGB.height)
        for name in ("fx", "fy", "cx", "cy"):
            assert getattr(again, name) == pytest.approx(getattr(RGB, name), rel=1e-12)

    @given(st.floats(-1, 1), st.floats(-1, 1))
    def test_a_point_keeps_its_place_in_the_picture(self, x, y):
        point = np.array([[x, y, 1.5]])
        small = RGB.scaled(301, 224)
        np.testing.assert_allclose(
            small.project(point) / [301, 224], RGB.project(point) / [5280, 3956], rtol=1e-12, atol=1e-12
        )

    @pytest.mark.parametrize(("width", "height"), [(600, 450), (8, 6), (1, 1), (2400, 1800)])
    def test_to_a_width_it_keeps_its_aspect(self, width, height):
        camera = Camera(1200, 900, 900.0, 900.0, 600.0, 450.0)
        assert camera.scaled_to_width(width) == camera.scaled(width, height)


class TestProjection:
    def test_the_axis_meets_the_principal_point(self):
        np.testing.assert_array_equal(RGB.project(np.array([[0.0, 0.0, 7.0]])), [[RGB.cx, RGB.cy]])

    def test_behind_and_beside_the_camera_is_nan(self):
        assert np.isnan(RGB.project(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))).all()

    def test_no_points(self):
        assert RGB.project(np.zeros((0, 3))).shape == (0, 2)

    @given(st.tuples(*[st.floats(-0.2, 0.2)] * 2, *[st.floats(-0.02, 0.02)] * 2), st.integers(0, 2**32 - 1))
    def test_distortion_against_opencv(self, distortion, seed):
        camera = Camera(640, 512, 500.0, 510.0, 321.0, 250.0, distortion)
        points = np.random.default_rng(seed).uniform([-2, -2, 3], [2, 2, 9], (5, 3))
        expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, np.array(distortion))
        np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)

    def test_without_distortion_keeps_the_matrix(self):
        camera = Camera(640, 512, 500.0, 510.0, 321.0, 250.0, (0.1, 0.0, 0.0, 0.0))
        assert camera.without_distortion().distortion == ()
        np.testing.assert_array_equal(camera.without_distortion().matrix, camera.matrix)


class TestColmapModels:
    @pytest.mark.parametrize(
        ("model", "params", "expected"),
        [
            ("SIMPLE_PINHOLE", [9, 3, 2], Camera(6, 4, 9, 9, 3, 2)),
            ("PINHOLE", [9, 8, 3, 2], Camera(6, 4, 9, 8, 3, 2)),
            ("SIMPLE_RADIAL", [9, 3, 2, 0.1], Camera(6, 4, 9, 9, 3, 2, (0.1, 0.0, 0.0, 0.0))),
            ("RADIAL", [9, 3, 2, 0.1, 0.2], Camera(6, 4, 9, 9, 3, 2, (0.1, 0.2, 0.0, 0.0))),
            ("OPENCV", [9, 8, 3, 2, 0.1, 0.2, 0.3, 0.4], Camera(6, 4, 9, 8, 3, 2, (0.1, 0.2, 0.3, 0.4))),
            ("OPENCV", [9, 8, 3, 2, 0, 0, 0, 0], Camera(6, 4, 9, 8, 3, 2)),
        ],
    )
    def test_known(self, model, params, expected):
        assert Camera.from_colmap(model, 6, 4, params) == expected

    def test_an_unknown_model_names_the_nearest(self):
        with pytest.raises(LodbenchError, match="PINHOL") as caught:
            Camera.from_colmap("PINHOL", 6, 4, [9, 8, 3, 2])
        assert "PINHOLE" in caught.value.hint

    def test_a_wrong_number_of_parameters(self):
        with pytest.raises(LodbenchError, match="takes 4 parameters"):
            Camera.from_colmap("PINHOLE", 6, 4, [9, 3, 2])


@pytest.mark.parametrize(
    "values", [(0, 4, 9, 9, 3, 2), (6, -4, 9, 9, 3, 2), (6, 4, 0, 9, 3, 2), (6, 4, 9, -1, 3, 2)]
)
def test_sizes_and_focal_lengths_are_positive(values):
    with pytest.raises(LodbenchError, match="positive"):
        Camera(*values)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_every_value_is_finite(value):
    for index in range(4):
        numbers = [9.0, 9.0, 3.0, 2.0]
        numbers[index] = value
        with pytest.raises(LodbenchError):
            Camera(6, 4, *numbers)


def test_sizes_are_whole_pixels():
    camera = Camera(640.0, np.int64(480), 9, 9, 3, 2)
    assert (camera.width, camera.height) == (640, 480)
    assert type(camera.width) is type(camera.height) is int
    for size in (640.5, math.nan, math.inf):
        with pytest.raises(LodbenchError, match="whole pixels"):
            Camera(size, 480, 9, 9, 3, 2)
