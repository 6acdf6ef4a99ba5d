"""The GL back end draws the same silhouettes, but for pixels on edges (it multisamples)."""

from __future__ import annotations

import numpy as np
import pytest
from hostile_scenes import box, scene_of, straight_down

from lodbench.errors import RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotation_from_euler
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


def test_depth_is_the_distance_along_the_axis(open_renderer):
    scene = scene_of(box([-5, -5, 0], [10, 10, 10]))
    depth = open_renderer(scene).depth(CAMERA, straight_down(60.0))
    assert depth[217, 303] == pytest.approx(50.0, abs=0.02)
    assert depth[0, 0] == 0


def test_another_image_size_on_the_same_context(open_renderer):
    scene = scene_of(box([-5, -5, 0], [10, 10, 10]))
    engine, peer = SilhouetteRenderer(scene, 1), open_renderer(scene)
    for size in ((602, 448), (301, 224), (64, 200)):
        camera = CAMERA.scaled(*size)
        ours, theirs = engine.render(camera, straight_down(60.0)), peer.render(camera, straight_down(60.0))
        assert theirs.shape == (size[1], size[0])
        assert np.count_nonzero(ours != theirs) < 0.01 * ours.size


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
