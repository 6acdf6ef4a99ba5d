"""Every lens against COLMAP's own code, where pycolmap is installed, and against OpenCV's."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.errors import ConfigError, LodbenchError
from lodbench.geometry import Camera, CameraSigmas, EulerAngles, rotation_from_euler
from lodbench.geometry.angles import turning_axes
from lodbench.geometry.camera import (
    CALIBRATED,
    CAMERA_PARAMETERS,
    MAKER,
    UNKNOWN,
    camera_columns,
    pixel_rays,
    split_sigmas,
)

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


def test_by_provenance():
    assert CALIBRATED.are_zero
    assert (MAKER.focal_percent, MAKER.center_percent, MAKER.k1) == (0.5, 0.35, 0.01)
    assert (UNKNOWN.focal_percent, UNKNOWN.center_percent, UNKNOWN.k1) == (1.5, 0.7, 0.03)


@given(
    st.tuples(st.floats(0, 100), st.floats(0, 100), st.floats(0, 10)).filter(any),
    st.sampled_from(["stated", "35mm", "dewarp"]),
)
def test_what_is_written_is_read(numbers, source):
    sigmas = CameraSigmas(*numbers, source)
    assert split_sigmas(["PINHOLE", "4", *sigmas.words()]) == (["PINHOLE", "4"], sigmas)


def test_words_that_lack_are_exact_and_percents_need_no_sign():
    assert split_sigmas(["PINHOLE"]) == (["PINHOLE"], None)
    assert split_sigmas(["PINHOLE", "sigma_f=2"])[1] == CameraSigmas(2.0, 0.0, 0.0, "stated")
    assert split_sigmas(["sigma_c=0.7%", "sigma_k1=0.03", "sigma_by=35mm"])[1] == CameraSigmas(
        0.0, 0.7, 0.03, "35mm"
    )
    assert CALIBRATED.words() == []


def test_a_focal_length_by_a_photo_is_not_one_that_a_person_stated():
    assert split_sigmas(["sigma_f=2"])[1].stated_focal_percent == 2.0
    assert MAKER.stated_focal_percent is None


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["sigma_q=1"], "no deviation of a camera"),
        (["sigma_f=1", "200"], "no deviation of a camera"),
        (["sigma_f=1", "sigma_f=1"], "given twice"),
        (["sigma_f="], "no value"),
        (["sigma_f=-1%"], r"sigma_f=-1% is not within 0 to 100%"),
        (["sigma_c=101%"], "not within"),
        (["sigma_k1=1%"], "not within 0 to 10"),
        (["sigma_k1=nan"], "not within"),
        (["sigma_f=wide"], "not within"),
    ],
)
def test_what_is_no_deviation(words, reason):
    with pytest.raises(LodbenchError, match=reason):
        split_sigmas(words)


FOCAL, CENTRE = (500.0, 510.0), (321.0, 250.0)
# Parameters of a size that real lenses have, for every model of COLMAP that a picture can have.
MODELS = {
    "SIMPLE_PINHOLE": (500.0, *CENTRE),
    "PINHOLE": (*FOCAL, *CENTRE),
    "SIMPLE_RADIAL": (500.0, *CENTRE, -0.12),
    "RADIAL": (500.0, *CENTRE, -0.12, 0.03),
    "OPENCV": (*FOCAL, *CENTRE, -0.26, 0.11, 0.001, -0.002),
    "FULL_OPENCV": (*FOCAL, *CENTRE, -0.26, 0.11, 0.001, -0.002, -0.03, 0.01, 0.002, -0.001),
    "SIMPLE_FISHEYE": (500.0, *CENTRE),
    "FISHEYE": (*FOCAL, *CENTRE),
    "SIMPLE_RADIAL_FISHEYE": (500.0, *CENTRE, 0.05),
    "RADIAL_FISHEYE": (500.0, *CENTRE, 0.05, -0.01),
    "OPENCV_FISHEYE": (*FOCAL, *CENTRE, 0.05, -0.01, 0.003, -0.002),
    "FOV": (*FOCAL, *CENTRE, 0.8),
    "THIN_PRISM_FISHEYE": (*FOCAL, *CENTRE, 0.05, -0.01, 0.001, -0.002, 0.003, -0.002, 0.004, -0.003),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *FOCAL, *CENTRE, 0.05, -0.01, 0.003, -0.002, 0.001, -0.0005,
        0.001, -0.002, 0.003, -0.002, 0.004, -0.003,
    ),
    "SIMPLE_DIVISION": (500.0, *CENTRE, -0.1),
    "DIVISION": (*FOCAL, *CENTRE, -0.1),
    "EUCM": (*FOCAL, *CENTRE, 0.4, 1.1),
}  # fmt: skip


@pytest.fixture(scope="module")
def points():
    return np.vstack([np.random.default_rng(3).uniform([-2, -2, 3], [2, 2, 9], (200, 3)), [[0, 0, 5.0]]])


@pytest.mark.parametrize("model", MODELS)
def test_projects_as_colmap_does(model, points):
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera(model=model, width=640, height=512, params=list(MODELS[model]))
    expected = theirs.img_from_cam(points)
    found = Camera.from_colmap(model, 640, 512, MODELS[model]).project(points)
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_there_and_back_in_colmap_s_terms(model, points):
    camera = Camera.from_colmap(model, 640, 512, MODELS[model])
    name, params = camera.to_colmap()
    again = Camera.from_colmap(name, 640, 512, params)
    assert again == camera
    assert bool(camera.distortion) == ("PINHOLE" not in model)


def test_full_model_against_opencv(points):
    camera = Camera.from_colmap("FULL_OPENCV", 640, 512, MODELS["FULL_OPENCV"])
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion)
    )
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)


def test_fisheye_against_opencv(points):
    camera = Camera.from_colmap("OPENCV_FISHEYE", 640, 512, MODELS["OPENCV_FISHEYE"])
    # OpenCV's fisheye takes pixel coordinates alike, and divides by z itself.
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion)
    )
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)


def test_a_fisheye_without_coefficients_is_no_pinhole():
    assert Camera.from_colmap("FISHEYE", 640, 512, MODELS["FISHEYE"]).distortion == (0.0, 0.0, 0.0, 0.0)
    assert Camera.from_colmap("OPENCV", 640, 512, (*FOCAL, *CENTRE, 0, 0, 0, 0)).distortion == ()


def test_what_is_no_lens_is_refused():
    with pytest.raises(LodbenchError, match="FISHY"):
        Camera.from_colmap("FISHY", 640, 512, (1.0,))
    with pytest.raises(LodbenchError, match="3 parameters"):
        Camera(640, 512, *FOCAL, *CENTRE, (0.1, 0.2, 0.3))
    with pytest.raises(LodbenchError, match="EQUIRECTANGULAR"):
        Camera.from_colmap("EQUIRECTANGULAR", 640, 512, (640.0, 512.0))


@pytest.fixture(scope="module")
def ray_points():
    xy = np.random.default_rng(5).uniform(-0.6, 0.6, (50, 2))
    return np.column_stack([np.vstack([xy, [[0.0, 0.0]]]), np.ones(51)])


@pytest.mark.parametrize("model", MODELS)
def test_a_ray_goes_back_where_its_pixel_came_from(model, ray_points):
    camera = Camera.from_colmap(model, 640, 512, MODELS[model])
    rays = pixel_rays(camera, camera.project(ray_points))
    np.testing.assert_allclose(rays.directions, ray_points, atol=1e-8)
    for axis in range(2):
        step = 1e-5 * np.eye(3)[axis]
        moved = (camera.project(ray_points + step) - camera.project(ray_points - step)) / 2e-5
        np.testing.assert_allclose(rays.pixel_by_point[:, :, axis], moved, atol=1e-3)
    unit = rays.pixel_by_point @ rays.point_by_pixel
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(2), unit.shape), atol=1e-9)


def test_no_ray_comes_from_beyond_where_a_lens_folds():
    camera = Camera.from_colmap("SIMPLE_RADIAL", 1000, 1000, (500.0, 500.0, 500.0, -0.4))
    directions = pixel_rays(camera, np.array([[500.0, 600.0], [999.0, 999.0]])).directions
    assert np.isfinite(directions[0]).all()
    assert np.isnan(directions[1, :2]).all()


def test_pixels_move_with_the_camera_as_their_projections_do(ray_points):
    camera = Camera.from_colmap("OPENCV", 640, 512, MODELS["OPENCV"])
    names = tuple(CAMERA_PARAMETERS)

    def moved(name: str, by: float) -> Camera:
        if name == "focal":
            return replace(camera, fx=camera.fx * (1 + by), fy=camera.fy * (1 + by))
        if name == "k1":
            return replace(camera, distortion=(camera.distortion[0] + by, *camera.distortion[1:]))
        return replace(camera, **{name: getattr(camera, name) + by})

    found = camera_columns(camera, pixel_rays(camera, camera.project(ray_points)), names)
    for column, name in enumerate(names):
        ahead, behind = (moved(name, by).project(ray_points) for by in (1e-5, -1e-5))
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
