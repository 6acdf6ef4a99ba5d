"""What all renderers keep to; bit-packed masks against numpy, silhouettes of buildings by the reference."""

import numpy as np
import pytest
from hostile_scenes import box, hostile_scenes, hostile_views, part_of, scene_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numba import njit

from lodbench.errors import ConfigError, RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotation_from_euler, rotations_at_yaws
from lodbench.kernels import masks as kernels
from lodbench.kernels.masks import count_bits
from lodbench.rendering import DEPTH, LAYERS, IouCounts, IouFit, make_renderer, open_renderer, renderers_with
from lodbench.rendering.masks import pack_mask, unpack_mask, words_per_row
from lodbench.rendering.reference import ReferenceRenderer
from lodbench.rendering.silhouette import SilhouetteRenderer

SMALL = Camera(65, 40, 50.0, 50.0, 32.0, 20.0)
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
    mask = reference.render(SMALL, Pose.from_euler(EulerAngles(30, 1, 5), (0, -20, 50)))
    expected = reference.counts(SMALL, rotations, centers, mask)
    for renderer in (engine, raster):
        ours = renderer.counts(SMALL, rotations, centers, mask)
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
        renderer.render(SMALL, broken)
    mask = renderer.render(SMALL, good)
    rotations, centers = np.repeat(good.rotation[None], 3, axis=0), np.repeat(good.center[None], 3, axis=0)
    rotations[1, 2, 0] = value
    for score in (
        lambda *poses: renderer.counts(SMALL, *poses, mask),
        lambda *poses: renderer.fit(SMALL, *poses, IouFit(mask)),
    ):
        with pytest.raises(RenderingError, match="Pose 1 of 3"):
            score(rotations, centers)
        with pytest.raises(RenderingError, match=r"rotations \(N, 3, 3\)"):
            score(rotations[0], centers)


masks = npst.arrays(np.bool_, st.tuples(st.integers(1, 6), st.integers(1, 200)))


@pytest.mark.parametrize(("width", "words"), [(1, 1), (63, 1), (64, 1), (65, 2), (128, 2), (602, 10)])
def test_words_per_row(width, words):
    assert words_per_row(width) == words


@given(masks)
def test_packing_and_unpacking_is_the_identity(mask):
    words = pack_mask(mask)
    assert words.dtype == np.uint64
    np.testing.assert_array_equal(unpack_mask(words, mask.shape[1]), mask)


def test_the_lowest_bit_is_the_leftmost_pixel():
    mask = np.zeros((1, 70), dtype=bool)
    mask[0, [0, 5, 64]] = True
    assert pack_mask(mask).tolist() == [[1 + 32, 1]]


@given(masks)
def test_counting_bits_is_counting_pixels(mask):
    assert count_bits(pack_mask(mask)) == np.count_nonzero(mask)


@njit
def intersect_and_clear(words, query):
    return kernels.intersect_and_clear(words, query)


@given(masks, st.integers(0, 2**32 - 1))
def test_intersection_and_area_against_numpy(mask, seed):
    other = np.random.default_rng(seed).random(mask.shape) < 0.5
    words = pack_mask(mask)
    assert intersect_and_clear(words, pack_mask(other)) == (
        np.count_nonzero(mask & other),
        np.count_nonzero(mask),
    )
    assert not words.any()


CAMERA = Camera(129, 96, 90.0, 89.0, 64.0, 49.0)


def assert_each_as_reference(scene, camera, pose) -> int:
    """Compares every building's mask with the reference's of that building alone; returns how many show."""
    instances = SilhouetteRenderer(scene, 1).instances(camera, pose)
    masks = dict(instances.masks())
    assert list(masks) == sorted(masks)
    assert len(masks) == len(instances)
    assert instances.areas().tolist() == [mask.sum() for mask in masks.values()]
    empty = np.zeros((camera.height, camera.width), dtype=bool)
    for b in range(scene.num_buildings):
        expected = empty
        if scene.triangle_starts[b + 1] > scene.triangle_starts[b]:
            expected = ReferenceRenderer(part_of(scene, [b])).render(camera, pose)
        np.testing.assert_array_equal(masks.get(b, empty), expected, err_msg=str(b))
        assert (b in masks) == expected.any()
    return len(masks)


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(hostile_scenes(), hostile_views())
def test_on_hostile_triangles(scene, view):
    assert_each_as_reference(scene, *view)


@pytest.mark.slow
def test_on_real_quarters(real_quarter):
    scene, place = real_quarter
    camera = Camera(101, 75, 72.0, 71.0, 51.0, 36.0)
    for pitch, yaw, distance in ((0, 10, 120), (75, -60, 100), (90, 200, 4)):
        rotation = rotation_from_euler(EulerAngles(pitch, 0.7, yaw))
        pose = Pose.from_center(rotation, place - distance * rotation[2])
        assert assert_each_as_reference(scene, camera, pose) > 1


def town():
    return scene_of(*(box([30 * i, 30 * j, 0], [20, 14, 9 + i + j]) for i in range(6) for j in range(6)))


def test_their_union_is_the_silhouette_and_nothing_is_left_behind():
    engine = SilhouetteRenderer(town(), 1)
    pose = Pose.from_euler(EulerAngles(55, 1, 20), (80, -40, 70))
    drawn = engine.render(CAMERA, pose)
    rotations, centers = pose.rotation[None], pose.center[None]
    before = engine.counts(CAMERA, rotations, centers, drawn)
    instances = engine.instances(CAMERA, pose)
    union = np.zeros_like(drawn)
    for _, mask in instances.masks():
        union |= mask
    np.testing.assert_array_equal(union, drawn)
    assert instances.areas().sum() > drawn.sum()  # they overlap
    # Scoring uses the same working memory.
    after = engine.counts(CAMERA, rotations, centers, drawn)
    assert (after.intersection[0], after.union[0]) == (before.intersection[0], before.union[0])


def test_a_crop_is_where_the_mask_is():
    instances = SilhouetteRenderer(town(), 1).instances(
        CAMERA, Pose.from_euler(EulerAngles(30, 1, 20), (60, 40, 120))
    )
    for k in range(len(instances)):
        crop, top, left = instances.crop(k)
        mask = instances.mask(k)
        assert crop[0].any()
        assert crop[-1].any()
        np.testing.assert_array_equal(mask[top : top + len(crop), left : left + crop.shape[1]], crop)
        assert mask.sum() == crop.sum()


def test_none_in_view():
    engine = SilhouetteRenderer(town(), 1)
    instances = engine.instances(CAMERA, Pose.from_euler(EulerAngles(0, 0, 0), (5000, 0, 90)))
    assert len(instances) == 0
    assert instances.areas().tolist() == []
    assert list(instances.masks()) == []


def test_what_cannot_be_drawn_is_refused():
    engine = SilhouetteRenderer(town(), 1)
    with pytest.raises(RenderingError, match="not finite"):
        engine.instances(CAMERA, Pose(np.eye(3), np.array([0.0, np.nan, 0.0])))
