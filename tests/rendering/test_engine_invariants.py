"""What must not change the engine's answer: threads, batches, the order and turn of triangles."""

import numpy as np
import pytest
from hostile_scenes import KINDS, box, hostile_scenes, hostile_views, scene_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lodbench.errors import RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotations_at_yaws
from lodbench.rendering.reference import ReferenceRenderer
from lodbench.rendering.registry import RenderAndCompare
from lodbench.rendering.silhouette import SilhouetteRenderer

CAMERA = Camera(129, 96, 90.0, 89.0, 64.0, 49.0)


def town(count: int = 6):
    rng = np.random.default_rng(5)
    return scene_of(
        *(
            box([30 * i, 30 * j, 0], rng.uniform(8, 24, 3), floor=bool(rng.integers(2)))
            for i in range(count)
            for j in range(count)
        )
    )


def swarm(count: int):
    """Returns hypotheses over the town, some of which see nothing."""
    rng = np.random.default_rng(6)
    centers = rng.uniform([-60, -60, 5], [240, 240, 140], (count, 3))
    return rotations_at_yaws(40.0, 1.0, rng.uniform(-180, 180, count)), centers


@pytest.fixture(scope="module")
def query():
    return SilhouetteRenderer(town(), 1).render(
        CAMERA, Pose.from_euler(EulerAngles(35, 1, 20), (80, 40, 110))
    )


def test_score_counts_the_pixels_of_render(query):
    engine = SilhouetteRenderer(town(), 1)
    rotations, centers = swarm(40)
    counts = engine.counts(CAMERA, rotations, centers, query)
    for i, (rotation, center) in enumerate(zip(rotations, centers, strict=True)):
        drawn = engine.render(CAMERA, Pose.from_center(rotation, center))
        # from_center and back may move the centre's last bit; here it moves no pixel.
        assert counts.intersection[i] == np.count_nonzero(drawn & query)
        assert counts.union[i] == np.count_nonzero(drawn | query)
    assert (counts.iou() > 0).any()
    assert (counts.iou() == 0).any()


@pytest.mark.parametrize("threads", [2, 3, 8])
@pytest.mark.parametrize("count", [1, 2, 13, 14, 52, 101])
def test_threads_change_nothing(query, threads, count):
    rotations, centers = swarm(count)
    one = SilhouetteRenderer(town(), 1).counts(CAMERA, rotations, centers, query)
    many = SilhouetteRenderer(town(), threads).counts(CAMERA, rotations, centers, query)
    np.testing.assert_array_equal(one.intersection, many.intersection)
    np.testing.assert_array_equal(one.union, many.union)


@given(st.lists(st.integers(1, 30), min_size=1, max_size=8))
def test_batches_change_nothing(sizes):
    engine = SilhouetteRenderer(town(3), 1)
    rotations, centers = swarm(sum(sizes))
    mask = engine.render(CAMERA, Pose.from_euler(EulerAngles(35, 1, 20), (40, 10, 110)))
    whole = engine.counts(CAMERA, rotations, centers, mask)
    cuts = np.cumsum(sizes)[:-1]
    parts = [
        engine.counts(CAMERA, r, c, mask)
        for r, c in zip(np.split(rotations, cuts), np.split(centers, cuts), strict=True)
    ]
    np.testing.assert_array_equal(whole.intersection, np.concatenate([p.intersection for p in parts]))
    np.testing.assert_array_equal(whole.union, np.concatenate([p.union for p in parts]))


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(hostile_scenes(), st.lists(hostile_views(), min_size=2, max_size=11), st.integers(0, 2**32 - 1))
def test_a_batch_in_which_some_must_clip_is_each_view_by_itself(scene, views, seed):
    camera, poses = views[0][0], [pose for _, pose in views]
    engine = SilhouetteRenderer(scene, 1)
    mask = np.random.default_rng(seed).random((camera.height, camera.width)) < 0.5
    centers = np.array([pose.center for pose in poses])
    counts = engine.counts(camera, np.array([pose.rotation for pose in poses]), centers, mask)
    drawn = [engine.render(camera, pose) for pose in poses]
    np.testing.assert_array_equal(counts.intersection, [np.count_nonzero(d & mask) for d in drawn])
    np.testing.assert_array_equal(counts.union, [np.count_nonzero(d | mask) for d in drawn])


def test_no_hypotheses_give_no_counts(query):
    counts = SilhouetteRenderer(town(), 2).counts(CAMERA, np.zeros((0, 3, 3)), np.zeros((0, 3)), query)
    assert counts.iou().shape == (0,)


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(st.sampled_from(KINDS), st.integers(0, 2**32 - 1), hostile_views())
def test_order_and_turn_of_triangles_change_nothing(kind, seed, view):
    rng = np.random.default_rng(seed)
    triangles = kind(rng).astype(np.float32)
    if not (np.diff(triangles, axis=1) != 0).any(axis=2).all(axis=1).any():
        return
    shuffled = np.array([t[rng.permutation(3)] for t in triangles[rng.permutation(len(triangles))]])
    first = SilhouetteRenderer(scene_of(triangles), 1).render(*view)
    # Which corner the fan of a clipped triangle starts from moves its inner edges by rounding.
    if np.count_nonzero(first ^ SilhouetteRenderer(scene_of(shuffled), 1).render(*view)):
        assert reaches_behind(triangles, view[1])


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(hostile_scenes(), hostile_views())
def test_one_building_per_triangle_is_the_same_picture(scene, view):
    apart = scene_of(*(scene.vertices[t][None] for t in scene.triangles))
    together = SilhouetteRenderer(scene, 1).render(*view)
    np.testing.assert_array_equal(SilhouetteRenderer(apart, 1).render(*view), together)


def reaches_behind(triangles, pose) -> bool:
    """Tells whether any triangle is clipped, at the near plane or in the guard band."""
    points = (triangles.reshape(-1, 3).astype(np.float64) - pose.center) @ pose.rotation.T
    return bool((points[:, 2] < 0.1).any() or (np.abs(points[:, :2]) > 10 * points[:, 2:]).any())


def test_a_mask_of_another_size_is_refused(query):
    with pytest.raises(RenderingError, match="129 x 96"):
        SilhouetteRenderer(town(2), 1).counts(CAMERA.scaled(64, 48), *swarm(1), query)


def test_a_distorted_camera_is_refused():
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, (0.1, 0.0, 0.0, 0.0))
    with pytest.raises(RenderingError, match="distortion"):
        SilhouetteRenderer(town(2), 1).render(camera, Pose.from_euler(EulerAngles(0, 0, 0), (0, 0, 50)))


def test_an_image_wider_than_the_guard_band_is_refused():
    with pytest.raises(RenderingError, match="8192"):
        SilhouetteRenderer(town(2), 1).render(
            Camera(8193, 1, 50.0, 50.0, 32.0, 1.0), Pose.from_euler(EulerAngles(0, 0, 0), (0, 0, 50))
        )


@pytest.mark.parametrize("apart_m", [0.0, 1e-12, 1e-3, 1.0])
def test_nearby_poses_are_drawn_each_for_itself(query, apart_m):
    # Batches share what they select and project; each pose must still get its own picture.
    rng = np.random.default_rng(8)
    base = Pose.from_euler(EulerAngles(35, 1, 20), (80, 40, 110))
    centers = base.center + apart_m * rng.uniform(-1, 1, (19, 3))
    rotations = rotations_at_yaws(35.0, 1.0, 20.0 + apart_m * rng.uniform(-1, 1, 19))
    counts = SilhouetteRenderer(town(), 1).counts(CAMERA, rotations, centers, query)
    reference = RenderAndCompare(ReferenceRenderer(town()))
    expected = reference.counts(CAMERA, rotations[::6], centers[::6], query)
    np.testing.assert_array_equal(counts.intersection[::6], expected.intersection)
    np.testing.assert_array_equal(counts.union[::6], expected.union)
    assert (len(set(counts.iou())) > 10) == (apart_m == 1.0)


@pytest.mark.parametrize("scale", [1e5, 1e7])
def test_swarms_far_from_the_origin(scale):
    # Corners snap to float32 there; the selection's rounding must not lose a building either.
    base = np.array([0.63, -0.77, 0.0]) * scale
    scene = scene_of(
        *(box(base + np.array([60 * i, 60 * j, 0]), [40, 32, 20 + 8 * i]) for i in range(4) for j in range(4))
    )
    rng = np.random.default_rng(9)
    centers = base + np.array([90, 20, 150]) + rng.uniform(-9, 9, (16, 3))
    rotations = rotations_at_yaws(40.0, 0.5, rng.uniform(-9, 9, 16))
    reference = RenderAndCompare(ReferenceRenderer(scene))
    mask = reference.render(CAMERA, Pose.from_center(rotations[3], centers[3]))
    assert mask.any()
    # from_center and back cost a centre of 1e7 m its last bits: the engine is asked for the same.
    poses = [Pose.from_center(r, c) for r, c in zip(rotations[::5], centers[::5], strict=True)]
    same = np.array([pose.center for pose in poses])
    ours = SilhouetteRenderer(scene, 1).counts(CAMERA, rotations[::5], same, mask)
    expected = reference.counts(CAMERA, rotations[::5], centers[::5], mask)
    np.testing.assert_array_equal(ours.intersection, expected.intersection)
    np.testing.assert_array_equal(ours.union, expected.union)
    assert (ours.iou() > 0).all()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (63, 40), (65, 33), (127, 50), (150, 41)])
def test_masks_whose_rows_end_within_a_word(width, height):
    camera = Camera(width, height, 90.0, 89.0, width / 2, height / 2)
    rotations, centers = swarm(9)
    mask = np.random.default_rng(10).random((height, width)) < 0.5
    ours = SilhouetteRenderer(town(), 2).counts(camera, rotations, centers, mask)
    expected = RenderAndCompare(SilhouetteRenderer(town(), 1)).counts(camera, rotations, centers, mask)
    np.testing.assert_array_equal(ours.intersection, expected.intersection)
    np.testing.assert_array_equal(ours.union, expected.union)
