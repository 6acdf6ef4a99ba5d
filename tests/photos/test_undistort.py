"""Undistorting: round trips through every lens, OpenCV as the oracle, and no pixel that the photo lacks."""

import cv2
import numpy as np
import pytest

from lodbench.errors import DatasetError
from lodbench.geometry import Camera
from lodbench.photos.undistort import pinhole_of, undistorted
from tests.geometry.test_lens import MODELS

LENSES = [name for name in MODELS if "PINHOLE" not in name]
DJI = Camera(
    1368, 912, 916.5, 915.0, 680.9, 458.1, (-0.2651, 0.1123, 0.0002, -0.0004, -0.0331, 0, 0, 0), "FULL_OPENCV"
)


def scene_picture(camera: Camera) -> np.ndarray:
    """Returns a smooth pattern on the plane z = 1 as a camera of any lens sees it, by inverting the lens.

    Independent of the code under test: rays come from a dense table of projected points.
    """
    x, y = np.meshgrid(np.linspace(-2, 2, 121), np.linspace(-2, 2, 121))
    points = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    pixels = camera.project(points)
    from scipy.interpolate import CloughTocher2DInterpolator

    near = (
        np.isfinite(pixels).all(axis=1)
        & (
            np.abs(pixels - [camera.width / 2, camera.height / 2]) < [camera.width * 0.6, camera.height * 0.6]
        ).all(1)
        & (np.hypot(*points[:, :2].T) < 1.6)
    )
    inverse = CloughTocher2DInterpolator(pixels[near], points[near, :2])
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = inverse(np.stack([u.ravel(), v.ravel()], axis=1))
    return pattern(rays).reshape(camera.height, camera.width)


def pattern(rays: np.ndarray) -> np.ndarray:
    return (0.5 + 0.25 * np.sin(9 * rays[:, 0]) + 0.25 * np.cos(7 * rays[:, 1] + 2)).astype(np.float32)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "FOV", "THIN_PRISM_FISHEYE", "DIVISION"])
def test_a_distorted_picture_becomes_the_pinhole_s(model):
    camera = Camera.from_colmap(model, 640, 512, MODELS[model]).scaled(160, 128)
    pinhole = pinhole_of(camera)
    found = undistorted(scene_picture(camera), camera, pinhole)
    u, v = np.meshgrid(np.arange(160) + 0.5, np.arange(128) + 0.5)
    rays = np.stack([(u - pinhole.cx).ravel() / pinhole.fx, (v - pinhole.cy).ravel() / pinhole.fy], axis=1)
    expected = pattern(rays).reshape(128, 160)
    # Linear interpolation of this pattern is good to a few thousandths; the rim is repeated.
    assert np.nanmax(np.abs(found - expected)[2:-2, 2:-2]) < 0.006


@pytest.mark.parametrize("model", LENSES)
def test_every_pixel_of_the_pinhole_is_in_the_photo(model):
    camera = Camera.from_colmap(model, 640, 512, MODELS[model])
    pinhole = pinhole_of(camera)
    assert pinhole.distortion == ()
    assert (pinhole.width, pinhole.height, pinhole.cx, pinhole.cy) == (640, 512, camera.cx, camera.cy)
    assert pinhole.fx / pinhole.fy == pytest.approx(camera.fx / camera.fy)
    u, v = np.meshgrid(np.arange(640) + 0.5, np.arange(512) + 0.5)
    rays = np.stack([(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy, np.ones_like(u)], axis=2)
    pixels = camera.project(rays.reshape(-1, 3))
    assert pixels.min() >= -1e-6
    assert (pixels <= [640 + 1e-6, 512 + 1e-6]).all()
    # And a wider one would not do, unless the limit was met.
    edge = np.abs(pixels - [[0, 0]]).min(0).min(), np.abs(pixels - [[640, 512]]).min()
    assert min(edge) < 1.0 or pinhole.fx == pytest.approx(0.6 * camera.fx)


def test_dji_s_calibration_as_opencv_undoes_it():
    picture = np.random.default_rng(0).integers(0, 256, (912, 1368, 3), dtype=np.uint8)
    picture = cv2.GaussianBlur(picture, (0, 0), 5)
    pinhole = pinhole_of(DJI)
    # OpenCV counts pixels from their centres: both principal points lie half a pixel less.
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    maps = cv2.initUndistortRectifyMap(
        DJI.matrix - half, np.array(DJI.distortion), None, pinhole.matrix - half, (1368, 912), cv2.CV_32FC1
    )
    expected = cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    found = undistorted(picture, DJI, pinhole)
    assert np.abs(found.astype(int) - expected).max() <= 1
    assert found.dtype == np.uint8


def test_a_mask_of_another_size_is_undistorted_alike():
    pinhole = pinhole_of(DJI)
    mask = np.zeros((912, 1368), np.float32)
    cv2.circle(mask, (1150, 700), 120, 1.0, -1)
    whole = undistorted(mask, DJI, pinhole)
    half = undistorted(cv2.resize(mask, (684, 456), interpolation=cv2.INTER_AREA), DJI, pinhole)
    shrunk = cv2.resize(whole, (684, 456), interpolation=cv2.INTER_AREA)
    assert np.abs(half - shrunk).mean() < 0.002
    assert ((half >= 0.5) != (shrunk >= 0.5)).sum() < 40


def test_a_pinhole_comes_back_as_it_is():
    camera = DJI.without_distortion()
    assert pinhole_of(camera) is camera


def test_parameters_of_no_lens_are_refused():
    with pytest.raises(DatasetError, match="cannot be undone"):
        pinhole_of(Camera(640, 480, 500.0, 500.0, 320.0, 240.0, (-90.0, 0.0, 0.0, 0.0)))
