"""The GL back end draws the same silhouettes, but for pixels on edges (it multisamples)."""

import numpy as np
import pytest
from hostile_scenes import box, scene_of, straight_down

from lodbench.errors import RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotation_from_euler
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.silhouette import SilhouetteRenderer

CAMERA = Camera(602, 448, 430.8, 426.6, 303.7, 217.4)


@pytest.fixture(scope="module")
def open_renderer():
    """Returns the renderer class, or skips with the reason; closes the context afterwards."""
    from lodbench.rendering.pyrender_backend import PyrenderRenderer, close_context

    try:
        PyrenderRenderer(scene_of(box([0, 0, 0], [1, 1, 1]))).render(CAMERA, straight_down(5.0))
    except RenderingError as error:
        pytest.skip(f"no pyrender here: {error}")
    yield PyrenderRenderer
    close_context()


def test_agrees_with_the_engine_on_real_cities(real_quarter, open_renderer):
    scene, place = real_quarter
    engine, peer = SilhouetteRenderer(scene, 1), open_renderer(scene)
    for pitch, yaw in ((0, 10), (30, -70), (55, 150)):
        rotation = rotation_from_euler(EulerAngles(pitch, 0.5, yaw))
        pose = Pose.from_center(rotation, place - 150.0 * rotation[2])
        ours = engine.render(CAMERA, pose)
        assert ours.any()
        assert np.count_nonzero(ours != peer.render(CAMERA, pose)) < 0.01 * ours.size


@pytest.mark.slow
def test_depth_is_the_distance_along_the_axis(open_renderer):
    scene = scene_of(box([-5, -5, 0], [10, 10, 10]))
    depth = open_renderer(scene).depth(CAMERA, straight_down(60.0))
    assert depth[217, 303] == pytest.approx(50.0, abs=0.02)
    assert depth[0, 0] == 0


@pytest.mark.slow
def test_another_image_size_on_the_same_context(open_renderer):
    scene = scene_of(box([-5, -5, 0], [10, 10, 10]))
    engine, peer = SilhouetteRenderer(scene, 1), open_renderer(scene)
    for size in ((602, 448), (301, 224), (64, 200)):
        camera = CAMERA.scaled(*size)
        ours, theirs = engine.render(camera, straight_down(60.0)), peer.render(camera, straight_down(60.0))
        assert theirs.shape == (size[1], size[0])
        assert np.count_nonzero(ours != theirs) < 0.01 * ours.size


@pytest.mark.slow
def test_two_scenes_take_turns_and_survive_a_new_context(open_renderer):
    from lodbench.rendering.pyrender_backend import close_context

    scenes = [scene_of(box([low, -5, 0], [10, 10, 10])) for low in (-5, 9)]
    renderers = [open_renderer(scene) for scene in scenes]
    for turn in range(4):
        if turn == 2:
            close_context()
        for scene, peer in zip(scenes, renderers, strict=True):
            ours = SilhouetteRenderer(scene, 1).render(CAMERA, straight_down(60.0))
            assert np.count_nonzero(ours != peer.render(CAMERA, straight_down(60.0))) < 0.01 * ours.size


@pytest.mark.slow
@pytest.mark.parametrize("samples", [1, 4])
def test_back_faces_are_seen(open_renderer, samples):
    # Under a box without a floor everything in view is the inside of a wall or of the roof.
    scene = scene_of(box([0, 0, 0], [10, 10, 10], floor=False))
    pose = Pose.from_euler(EulerAngles(180, 2, 15), (5, 5, -8))
    ours = SilhouetteRenderer(scene, 1).render(CAMERA, pose)
    assert ours.mean() > 0.2
    assert np.mean(ours != open_renderer(scene, samples=samples).render(CAMERA, pose)) < 0.01


@pytest.mark.slow
def test_one_sample_at_the_centre_covers_the_engines_pixels(open_renderer):
    scene = scene_of(*[box([4 * x, 4 * y, 0], [2.3, 2.7, 5]) for x in range(-5, 5) for y in range(-5, 5)])
    pose = Pose.from_euler(EulerAngles(25, 1, 33), (0, -10, 60))
    ours = SilhouetteRenderer(scene, 1).render(CAMERA, pose)
    shares = [
        np.mean(ours != open_renderer(scene, samples=samples).render(CAMERA, pose)) for samples in (4, 1, 4)
    ]
    assert shares[1] < 0.002 < shares[0]
    assert shares[0] == shares[2]


@pytest.mark.slow
def test_depth_from_a_hand_to_the_horizon(open_renderer):
    # 24 bits between 0.2 m and 3 km: one slice would be centimetres off at 200 m.
    scene = scene_of(box([0.2, -0.02, -0.02], [0.1, 0.04, 0.04]), box([200, -150, -50], [3000, 9, 90]))
    pose = Pose.from_euler(EulerAngles(90, 0, -90), (0, 0, 0))
    depth = open_renderer(scene).depth(CAMERA, pose)
    expected = RasterRenderer(scene, 1).depth(CAMERA, pose)
    both = (depth > 0) & (expected > 0)
    assert expected[both].min() < 0.3
    assert expected[both].max() > 190
    off = np.abs(depth - expected)[both] > 1e-3 + 1e-4 * expected[both]
    assert off.mean() < 0.005
