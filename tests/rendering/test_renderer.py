import numpy as np
import pytest
from hostile_scenes import box, scene_of

from lodbench.errors import ConfigError, RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotations_at_yaws
from lodbench.rendering import DEPTH, LAYERS, IouCounts, IouFit, make_renderer, open_renderer, renderers_with

CAMERA = Camera(65, 40, 50.0, 50.0, 32.0, 20.0)
SCENE = scene_of(box([-5, -5, 0], [10, 10, 10]), box([12, 0, 0], [4, 9, 20]))


def test_an_unknown_renderer_names_the_nearest():
    with pytest.raises(ConfigError, match="silhuette") as caught:
        make_renderer("silhuette", SCENE)
    assert "silhouette" in caught.value.hint


def test_every_renderer_without_extras_scores_alike():
    rng = np.random.default_rng(0)
    rotations = rotations_at_yaws(30.0, 1.0, rng.uniform(-180, 180, 6))
    centers = rng.uniform([-30, -30, 40], [30, 30, 60], (6, 3))
    engine, reference, raster = (
        make_renderer(name, SCENE, 1) for name in ("silhouette", "reference", "raster")
    )
    mask = reference.render(CAMERA, Pose.from_euler(EulerAngles(30, 1, 5), (0, -20, 50)))
    expected = reference.counts(CAMERA, rotations, centers, mask)
    for renderer in (engine, raster):
        ours = renderer.counts(CAMERA, rotations, centers, mask)
        np.testing.assert_array_equal(ours.intersection, expected.intersection)
        np.testing.assert_array_equal(ours.union, expected.union)
    assert engine.name == "silhouette"
    assert reference.name == "reference"


def test_iou_of_an_empty_union_is_zero():
    counts = IouCounts(np.array([0, 3, 0]), np.array([0, 4, 7]))
    assert counts.iou().tolist() == [0.0, 0.75, 0.0]


def test_every_renderer_draws_silhouettes():
    assert {"silhouette", "reference", "raster", "pyrender", "open3d"} <= set(renderers_with("render"))


def test_what_a_renderer_is_said_to_have_it_has():
    for name in ("silhouette", "reference", "raster"):
        renderer = open_renderer(name, SCENE, 1)
        assert hasattr(renderer, "depth") == (name in renderers_with(DEPTH))
        assert hasattr(renderer, "draw") == (name in renderers_with(LAYERS))


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["silhouette", "reference", "raster"])
def test_poses_that_are_not_finite_are_refused(name, value):
    renderer = make_renderer(name, SCENE, 1)
    good = Pose.from_euler(EulerAngles(30, 1, 5), (0, -20, 50))
    broken = Pose(good.rotation, np.array([0.0, value, 0.0]))
    with pytest.raises(RenderingError, match="Pose 0 of 1 has values that are not finite"):
        renderer.render(CAMERA, broken)
    mask = renderer.render(CAMERA, good)
    rotations, centers = np.repeat(good.rotation[None], 3, axis=0), np.repeat(good.center[None], 3, axis=0)
    rotations[1, 2, 0] = value
    for score in (
        lambda *poses: renderer.counts(CAMERA, *poses, mask),
        lambda *poses: renderer.fit(CAMERA, *poses, IouFit(mask)),
    ):
        with pytest.raises(RenderingError, match="Pose 1 of 3"):
            score(rotations, centers)
        with pytest.raises(RenderingError, match=r"rotations \(N, 3, 3\)"):
            score(rotations[0], centers)
