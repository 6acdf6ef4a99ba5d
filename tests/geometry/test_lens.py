"""Every lens against COLMAP's own code, where pycolmap is installed, and against OpenCV's."""

import cv2
import numpy as np
import pytest

from lodbench.errors import LodbenchError
from lodbench.geometry import Camera

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
