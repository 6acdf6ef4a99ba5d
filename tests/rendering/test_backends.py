"""All renderers see the same cities; what is absent is named; a driver that hangs or crashes is given up."""

import builtins
import subprocess
import sys
import time

import numpy as np
import pytest
from hostile_scenes import box, scene_of, straight_down

from lodbench.citymodel import open_scene
from lodbench.errors import RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotation_from_euler
from lodbench.rendering import backends, make_renderer, open_renderer
from lodbench.rendering.backends import import_fault, pixel_rays
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.silhouette import SilhouetteRenderer

# Full intrinsics: two focal lengths, a principal point well off the centre.
CAMERA = Camera(602, 448, 430.8, 376.6, 253.7, 287.4)
CITIES = {
    "uavd4l": "uavd4l/UAVD4L-LoD1.obj",
    "plateau": "city/plateau/53395404_bldg_6697_op.gml",
    "nrw": "city/germany_lod2/LoD2_32_280_5657_1_NW.gml",
}
# Pitch, yaw, metres from the target back along the axis (0 and less: in and behind it).
VIEWS = [(0, 10, 150), (35, -70, 180), (60, 150, 220), (85, 20, 60), (90, 200, 0), (150, 40, 30), (70, 0, 1)]
MAX_MASK_SHARE = {"open3d": 0.001, "pyrender": 0.01, "pyrender-single": 0.002}


@pytest.fixture(scope="module", params=sorted(CITIES))
def city(request, shared_data):
    """A real city and its median vertex."""
    scene = open_scene(shared_data / CITIES[request.param])
    return scene, np.median(scene.vertices.astype(np.float64), axis=0)


def open_or_skip(name, scene):
    try:
        if name == "pyrender-single":
            from lodbench.rendering.backends import PyrenderRenderer

            renderer = PyrenderRenderer(scene, samples=1)
        else:
            renderer = open_renderer(name, scene, 1)
        renderer.render(CAMERA, Pose.from_euler(EulerAngles(0, 0, 0), (0, 0, 100)))
    except RenderingError as error:
        pytest.skip(f"no {name} here: {error} {error.hint}")
    return renderer


@pytest.fixture(scope="module", autouse=True)
def release_context():
    """Closes the GL context that the tests of this module may have opened."""
    yield
    from lodbench.rendering.backends import close_context

    close_context()


def poses(target):
    for pitch, yaw, back in VIEWS:
        rotation = rotation_from_euler(EulerAngles(pitch, 0.8, yaw))
        yield Pose.from_center(rotation, target - back * rotation[2])


def beside_jumps(depth):
    """Returns where a pixel or one of its eight neighbours is empty or at quite another depth."""
    padded = np.pad(depth.astype(np.float64), 1, mode="edge")
    height, width = depth.shape
    around = np.stack([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)])
    low, high = around.min(axis=0), around.max(axis=0)
    return (low == 0) | (high - low > 0.5 + 0.02 * low)


def test_engine_and_raster_to_the_bit(city):
    scene, target = city
    engine, raster = SilhouetteRenderer(scene, 1), RasterRenderer(scene, 1)
    for pose in poses(target):
        np.testing.assert_array_equal(engine.render(CAMERA, pose), raster.render(CAMERA, pose))


@pytest.mark.nightly
@pytest.mark.parametrize("name", sorted(MAX_MASK_SHARE))
def test_masks(city, name):
    scene, target = city
    peer, raster = open_or_skip(name, scene), RasterRenderer(scene, 1)
    shares = [np.mean(raster.render(CAMERA, pose) != peer.render(CAMERA, pose)) for pose in poses(target)]
    # With several samples, none at the centre, the share is that of edge pixels: a view full of small
    # houses has more of them, so it is the views' mean that is bounded.
    assert (np.mean(shares) if name == "pyrender" else max(shares)) <= MAX_MASK_SHARE[name]


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["open3d", "pyrender"])
def test_depths(city, name):
    scene, target = city
    peer, raster = open_or_skip(name, scene), RasterRenderer(scene, 1)
    compared = 0
    for pose in poses(target):
        ours, theirs = raster.depth(CAMERA, pose), peer.depth(CAMERA, pose)
        kept = (ours > 0) & (theirs > 0) & ~beside_jumps(ours)
        compared += np.count_nonzero(kept)
        off = np.abs(ours - theirs)[kept] > 1e-3 + 1e-4 * ours[kept]
        assert np.count_nonzero(off) <= 0.005 * kept.sum()
    assert compared > 100_000


PYRENDER_CAMERA = Camera(602, 448, 430.8, 426.6, 303.7, 217.4)


@pytest.fixture(scope="module")
def pyrender_class():
    """Returns the renderer class, or skips with the reason; closes the context afterwards."""
    from lodbench.rendering.backends import PyrenderRenderer, close_context

    try:
        PyrenderRenderer(scene_of(box([0, 0, 0], [1, 1, 1]))).render(PYRENDER_CAMERA, straight_down(5.0))
    except RenderingError as error:
        pytest.skip(f"no pyrender here: {error}")
    yield PyrenderRenderer
    close_context()


def test_agrees_with_the_engine_on_real_cities(real_quarter, pyrender_class):
    scene, place = real_quarter
    engine, peer = SilhouetteRenderer(scene, 1), pyrender_class(scene)
    for pitch, yaw in ((0, 10), (30, -70), (55, 150)):
        rotation = rotation_from_euler(EulerAngles(pitch, 0.5, yaw))
        pose = Pose.from_center(rotation, place - 150.0 * rotation[2])
        ours = engine.render(PYRENDER_CAMERA, pose)
        assert ours.any()
        assert np.count_nonzero(ours != peer.render(PYRENDER_CAMERA, pose)) < 0.01 * ours.size


@pytest.mark.slow
def test_depth_is_the_distance_along_the_axis(pyrender_class):
    scene = scene_of(box([-5, -5, 0], [10, 10, 10]))
    depth = pyrender_class(scene).depth(PYRENDER_CAMERA, straight_down(60.0))
    assert depth[217, 303] == pytest.approx(50.0, abs=0.02)
    assert depth[0, 0] == 0


@pytest.mark.slow
def test_another_image_size_on_the_same_context(pyrender_class):
    scene = scene_of(box([-5, -5, 0], [10, 10, 10]))
    engine, peer = SilhouetteRenderer(scene, 1), pyrender_class(scene)
    for size in ((602, 448), (301, 224), (64, 200)):
        camera = PYRENDER_CAMERA.scaled(*size)
        ours, theirs = engine.render(camera, straight_down(60.0)), peer.render(camera, straight_down(60.0))
        assert theirs.shape == (size[1], size[0])
        assert np.count_nonzero(ours != theirs) < 0.01 * ours.size


@pytest.mark.slow
def test_two_scenes_take_turns_and_survive_a_new_context(pyrender_class):
    from lodbench.rendering.backends import close_context

    scenes = [scene_of(box([low, -5, 0], [10, 10, 10])) for low in (-5, 9)]
    renderers = [pyrender_class(scene) for scene in scenes]
    for turn in range(4):
        if turn == 2:
            close_context()
        for scene, peer in zip(scenes, renderers, strict=True):
            ours = SilhouetteRenderer(scene, 1).render(PYRENDER_CAMERA, straight_down(60.0))
            assert (
                np.count_nonzero(ours != peer.render(PYRENDER_CAMERA, straight_down(60.0))) < 0.01 * ours.size
            )


@pytest.mark.slow
@pytest.mark.parametrize("samples", [1, 4])
def test_back_faces_are_seen(pyrender_class, samples):
    # Under a box without a floor everything in view is the inside of a wall or of the roof.
    scene = scene_of(box([0, 0, 0], [10, 10, 10], floor=False))
    pose = Pose.from_euler(EulerAngles(180, 2, 15), (5, 5, -8))
    ours = SilhouetteRenderer(scene, 1).render(PYRENDER_CAMERA, pose)
    assert ours.mean() > 0.2
    assert np.mean(ours != pyrender_class(scene, samples=samples).render(PYRENDER_CAMERA, pose)) < 0.01


@pytest.mark.slow
def test_one_sample_at_the_centre_covers_the_engines_pixels(pyrender_class):
    scene = scene_of(*[box([4 * x, 4 * y, 0], [2.3, 2.7, 5]) for x in range(-5, 5) for y in range(-5, 5)])
    pose = Pose.from_euler(EulerAngles(25, 1, 33), (0, -10, 60))
    ours = SilhouetteRenderer(scene, 1).render(PYRENDER_CAMERA, pose)
    shares = [
        np.mean(ours != pyrender_class(scene, samples=samples).render(PYRENDER_CAMERA, pose))
        for samples in (4, 1, 4)
    ]
    assert shares[1] < 0.002 < shares[0]
    assert shares[0] == shares[2]


@pytest.mark.slow
def test_depth_from_a_hand_to_the_horizon(pyrender_class):
    # 24 bits between 0.2 m and 3 km: one slice would be centimetres off at 200 m.
    scene = scene_of(box([0.2, -0.02, -0.02], [0.1, 0.04, 0.04]), box([200, -150, -50], [3000, 9, 90]))
    pose = Pose.from_euler(EulerAngles(90, 0, -90), (0, 0, 0))
    depth = pyrender_class(scene).depth(PYRENDER_CAMERA, pose)
    expected = RasterRenderer(scene, 1).depth(PYRENDER_CAMERA, pose)
    both = (depth > 0) & (expected > 0)
    assert expected[both].min() < 0.3
    assert expected[both].max() > 190
    off = np.abs(depth - expected)[both] > 1e-3 + 1e-4 * expected[both]
    assert off.mean() < 0.005


OPEN3D_CAMERA = Camera(160, 120, 115.0, 100.0, 70.3, 66.8)
TOWN = scene_of(box([-5, -5, 0], [10, 10, 10]), box([12, 0, 0], [4, 9, 20], floor=False))


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
    peer, pose = open_or_skip("open3d", TOWN), Pose.from_euler(EulerAngles(pitch, 2, 15), center)
    layers = RasterRenderer(TOWN, 1).draw(OPEN3D_CAMERA, pose)
    mask, depth = peer.render(OPEN3D_CAMERA, pose), peer.depth(OPEN3D_CAMERA, pose)
    assert np.count_nonzero(mask != layers.mask) <= 0.001 * mask.size
    assert ((depth > 0) == mask).all()
    both = mask & layers.mask
    assert np.mean(np.abs(depth - layers.depth)[both] > 1e-3 + 1e-4 * layers.depth[both]) < 0.005


def test_scores_like_any_renderer():
    open_or_skip("open3d", TOWN)
    scorer = make_renderer("open3d", TOWN, 1)
    pose = straight_down(60.0)
    counts = scorer.counts(
        OPEN3D_CAMERA, pose.rotation[None], pose.center[None], scorer.render(OPEN3D_CAMERA, pose)
    )
    assert counts.iou().tolist() == [1.0]


def test_rays_pass_through_pixel_centres():
    pose = Pose.from_euler(EulerAngles(30, 2, 15), (10, 20, 30))
    rays = pixel_rays(OPEN3D_CAMERA, pose).astype(np.float64)
    points = rays[..., :3] + 40.0 * rays[..., 3:]
    pixels = OPEN3D_CAMERA.project(points.reshape(-1, 3) @ pose.rotation.T + pose.translation)
    columns, rows = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    np.testing.assert_allclose(pixels[:, 0], columns.ravel(), atol=1e-3)
    np.testing.assert_allclose(pixels[:, 1], rows.ravel(), atol=1e-3)


NO_FILE = "cannot open shared object file: No such file"


@pytest.mark.parametrize(
    ("renderer", "message", "hint"),
    [
        ("pyrender", "No module named 'pyrender'", "lodbench[render]"),
        ("open3d", "No module named 'open3d'", "lodbench[render]"),
        ("open3d", f"libusb-1.0.so.0: {NO_FILE}", "apt-get install libusb-1.0-0 "),
        ("open3d", f"libgomp.so.1: {NO_FILE}", "apt-get install libgomp1 "),
        ("open3d", f"libX11.so.6: {NO_FILE}", "apt-get install libx11-6 "),
        ("open3d", f"libGL.so.1: {NO_FILE}", "apt-get install libgl1 "),
        ("open3d", f"libodd.so.7: {NO_FILE}", "libgl1 libgomp1 libusb-1.0-0 libx11-6"),
    ],
)
def test_what_is_absent_is_named_with_its_package(monkeypatch, renderer, message, hint):
    real_import = builtins.__import__

    def absent(name, *args, **kwargs):
        if name == renderer:
            raise ImportError(message)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(RenderingError, match=renderer) as caught:
        make_renderer(renderer, TOWN)
    assert hint in caught.value.hint


def test_without_egl_pyrender_names_its_package():
    message = ("Unable to load EGL library", "EGL: cannot open shared object file", "EGL", None)
    fault = import_fault("pyrender", ImportError(*message))
    assert "libEGL.so.1" in fault.message
    assert "apt-get install libegl1 " in fault.hint


@pytest.fixture
def untried(monkeypatch):
    """A process that has not tried the driver yet; and a way to say what a trial does."""
    monkeypatch.setattr(backends, "_is_tried", type(backends._is_tried)())
    return lambda script: monkeypatch.setattr(backends, "_TRIAL", (sys.executable, "-c", script))


def test_one_that_hangs_is_given_up(untried):
    untried("import time; time.sleep(60)")
    started = time.monotonic()
    with pytest.raises(RenderingError, match="no answer within 1 s") as caught:
        backends.require_driver(1.0)
    assert time.monotonic() - started < 30
    assert "doctor" in caught.value.hint


@pytest.mark.parametrize(
    ("trial", "reason"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "SIGSEGV"),
        ("import sys; sys.exit('no EGL here')", "cannot draw: no EGL here"),
    ],
)
def test_one_that_crashes_or_fails_says_why(untried, trial, reason):
    untried(trial)
    with pytest.raises(RenderingError, match=reason):
        backends.require_driver()


def test_one_that_draws_is_tried_once(untried):
    untried("")
    backends.require_driver()
    untried("import sys; sys.exit('again')")
    backends.require_driver()


def test_the_renderer_asks_before_it_draws(untried):
    pytest.importorskip("pyrender")
    untried("import sys; sys.exit('no EGL here')")
    renderer = open_renderer("pyrender", scene_of(box([-3, -3, 0], [6, 6, 9])))
    with pytest.raises(RenderingError, match="no EGL here"):
        renderer.render(Camera(16, 16, 8.0, 8.0, 8.0, 8.0), Pose.from_euler(EulerAngles(0, 0, 0), (0, 0, 40)))


@pytest.mark.slow
def test_a_draw_without_end_ends_the_process_with_the_reason():
    script = (
        "import time; from lodbench.rendering.backends import Watch; watch = Watch(0.5, 0.1)\n"
        "for _ in range(3):\n"
        "    with watch.watching(): time.sleep(0.2)\n"
        "time.sleep(1)\n"
        "print('drawn', flush=True)\n"
        "with watch.watching(): time.sleep(60)\n"
        "print('never')"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=50)
    assert done.returncode == 2
    assert done.stdout == "drawn\n"
    assert "has not answered for 0.5 s" in done.stderr
