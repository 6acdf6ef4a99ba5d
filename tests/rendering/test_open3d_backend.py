"""Ray casting draws the same city, but for float32 on edges; absent libraries are named."""

import builtins

import numpy as np
import pytest
from hostile_scenes import box, scene_of, straight_down

from lodbench.errors import RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.rendering import make_renderer
from lodbench.rendering.open3d_backend import Open3dRenderer, pixel_rays
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.system_libraries import import_fault

CAMERA = Camera(160, 120, 115.0, 100.0, 70.3, 66.8)
TOWN = scene_of(box([-5, -5, 0], [10, 10, 10]), box([12, 0, 0], [4, 9, 20], floor=False))


def open_or_skip(scene):
    try:
        return Open3dRenderer(scene, 1)
    except RenderingError as error:
        pytest.skip(f"no Open3D here: {error} {error.hint}")


@pytest.mark.parametrize(
    ("center", "pitch"),
    [
        ((0, 0, 60), 0),
        ((0, -40, 50), 40),
        ((0, 0, 5), 80),
        ((14, 4, 5), 60),
        ((14, 4, -9), 170),
        ((3, 3, 10.05), 0),
    ],
)
def test_agrees_with_the_raster(center, pitch):
    peer, pose = open_or_skip(TOWN), Pose.from_euler(EulerAngles(pitch, 2, 15), center)
    layers = RasterRenderer(TOWN, 1).draw(CAMERA, pose)
    mask, depth = peer.render(CAMERA, pose), peer.depth(CAMERA, pose)
    assert np.count_nonzero(mask != layers.mask) <= 0.001 * mask.size
    assert ((depth > 0) == mask).all()
    both = mask & layers.mask
    assert np.mean(np.abs(depth - layers.depth)[both] > 1e-3 + 1e-4 * layers.depth[both]) < 0.005


def test_scores_like_any_renderer():
    open_or_skip(TOWN)
    scorer = make_renderer("open3d", TOWN, 1)
    pose = straight_down(60.0)
    counts = scorer.counts(CAMERA, pose.rotation[None], pose.center[None], scorer.render(CAMERA, pose))
    assert counts.iou().tolist() == [1.0]


def test_rays_pass_through_pixel_centres():
    pose = Pose.from_euler(EulerAngles(30, 2, 15), (10, 20, 30))
    rays = pixel_rays(CAMERA, pose).astype(np.float64)
    points = rays[..., :3] + 40.0 * rays[..., 3:]
    pixels = CAMERA.project(points.reshape(-1, 3) @ pose.rotation.T + pose.translation)
    columns, rows = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    np.testing.assert_allclose(pixels[:, 0], columns.ravel(), atol=1e-3)
    np.testing.assert_allclose(pixels[:, 1], rows.ravel(), atol=1e-3)


@pytest.mark.parametrize(
    ("message", "hint"),
    [
        ("No module named 'open3d'", "lodbench[render]"),
        ("libusb-1.0.so.0: cannot open shared object file: No such file", "apt-get install libusb-1.0-0 "),
        ("libgomp.so.1: cannot open shared object file: No such file", "apt-get install libgomp1 "),
        ("libX11.so.6: cannot open shared object file: No such file", "apt-get install libx11-6 "),
        ("libGL.so.1: cannot open shared object file: No such file", "apt-get install libgl1 "),
        (
            "libodd.so.7: cannot open shared object file: No such file",
            "libgl1 libgomp1 libusb-1.0-0 libx11-6",
        ),
    ],
)
def test_what_is_absent_is_named_with_its_package(monkeypatch, message, hint):
    real_import = builtins.__import__

    def absent(name, *args, **kwargs):
        if name == "open3d":
            raise ImportError(message)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(RenderingError, match="open3d") as caught:
        make_renderer("open3d", TOWN)
    assert hint in caught.value.hint


def test_without_egl_pyrender_names_its_package():
    message = ("Unable to load EGL library", "EGL: cannot open shared object file", "EGL", None)
    fault = import_fault("pyrender", ImportError(*message))
    assert "libEGL.so.1" in fault.message
    assert "apt-get install libegl1 " in fault.hint
