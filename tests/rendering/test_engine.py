"""The engine: the reference on every pixel, silhouettes by hand, and what must not change an answer."""

import numpy as np
import pytest
from hostile_scenes import KINDS, SIZES, box, hostile_scenes, hostile_views, scene_of, straight_down
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lodbench.errors import RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotation_from_euler, rotations_at_yaws
from lodbench.rendering.reference import ReferenceRenderer
from lodbench.rendering.renderer import RenderAndCompare
from lodbench.rendering.silhouette import SilhouetteRenderer


def assert_same(scene, camera, pose):
    """Renders with both and returns the picture."""
    ours = SilhouetteRenderer(scene, 1).render(camera, pose)
    expected = ReferenceRenderer(scene).render(camera, pose)
    assert ours.shape == (camera.height, camera.width)
    np.testing.assert_array_equal(ours, expected)
    return ours


@pytest.mark.slow
@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow])
@given(hostile_scenes(), hostile_views())
def test_on_hostile_triangles(scene, view):
    assert_same(scene, *view)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__.strip("_"))
@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 90.0])
def test_on_each_kind_of_triangle(kind, tilt_deg):
    camera = Camera(130, 97, 80.0, 79.0, 64.0, 50.0)
    rotation = rotation_from_euler(EulerAngles(tilt_deg, 3.0, 20.0))
    for seed in range(4):
        scene = scene_of(kind(np.random.default_rng(seed)), box([-3, -3, -3], [6, 6, 6]))
        for distance in (2.0, 40.0, 90.0):
            assert assert_same(scene, camera, Pose.from_center(rotation, -distance * rotation[2])).any()


@pytest.mark.parametrize(("width", "height"), [*SIZES, (1, 448), (8192, 1), (1, 8192), (301, 224)])
def test_at_every_image_size(width, height):
    scene = scene_of(box([-30, -30, 0], [25, 70, 20]), box([0, -5, 0], [9, 9, 30], floor=False))
    camera = Camera(width, height, 0.6 * width, 0.6 * height, width / 2, height / 2)
    assert assert_same(scene, camera, Pose.from_euler(EulerAngles(20, 1, 33), (10, -30, 90))).any()


@pytest.mark.parametrize("floor", [True, False])
@pytest.mark.parametrize(
    "center",
    [(5, 5, 5), (5, 5, -8), (5, 5, 0), (0, 0, 0), (0, 5, 5), (10.05, 5, 5), (5, 5, 10.1), (5, 5, 10)],
)
def test_camera_inside_below_and_on_a_building(center, floor):
    scene = scene_of(box([0, 0, 0], [10, 10, 10], floor=floor))
    camera = Camera(65, 49, 40.0, 40.0, 32.0, 24.0)
    for pitch in (0.0, 60.0, 90.0, 130.0, 180.0):
        assert_same(scene, camera, Pose.from_euler(EulerAngles(pitch, 2.0, 77.0), center))


def test_corners_level_with_the_camera():
    # z is exactly 0 in camera axes: 1 / z is infinite, and must neither raise nor show.
    scene = scene_of(box([0, 0, 0], [10, 10, 10]), box([-4, -4, -30], [8, 8, 8]))
    for height in (0.0, 10.0):
        assert assert_same(scene, Camera(65, 49, 40.0, 40.0, 32.0, 24.0), straight_down(height)).any()


@pytest.mark.parametrize("scale", [1e4, 1e6, 1e9])
def test_far_from_the_origin(scale):
    # Corners snap to float32 here; both must see the same snapped corners.
    base = np.array([0.37, -0.81, 0.1]) * scale
    scene = scene_of(box(base, [3e-3 * scale] * 3))
    target = scene.vertices.astype(np.float64).mean(axis=0)
    pose = Pose.from_euler(EulerAngles(40, 1, 12), (0, 0, 0))
    pose = Pose.from_center(pose.rotation, target - 8e-3 * scale * pose.rotation[2])
    assert 0.01 < assert_same(scene, Camera(129, 80, 100.0, 100.0, 60.0, 40.0), pose).mean() < 0.6


def test_a_building_that_slides_over_each_border():
    # Culling by bounding sphere must not lose the last covered column or row.
    scene = scene_of(box([-0.5, -0.5, 0], [1, 1, 1]))
    camera = Camera(64, 48, 100.0, 100.0, 32.0, 24.0)
    seen = []
    for axis, half in ((0, 32), (1, 24)):
        for shift_px in np.linspace(half - 11, half + 11, 45):
            for sign in (-1, 1):
                center = np.array([0.0, 0.0, 11.0])
                center[axis] = sign * shift_px / 10.0
                seen.append(
                    assert_same(scene, camera, Pose.from_center(straight_down(0).rotation, center)).sum()
                )
    assert min(seen) == 0
    assert max(seen) > 100  # roof and a wall
    assert len(set(seen)) > 8


@pytest.mark.slow
def test_real_quarters(real_quarter):
    scene, place = real_quarter
    camera = Camera(101, 75, 72.0, 71.0, 51.0, 36.0)
    for pitch, yaw, distance in ((0, 10, 120), (45, 130, 150), (75, -60, 100), (90, 200, 4)):
        rotation = rotation_from_euler(EulerAngles(pitch, 0.7, yaw))
        pose = Pose.from_center(rotation, place - distance * rotation[2])
        assert assert_same(scene, camera, pose).any()


@pytest.mark.parametrize("copies", [32_768, 65_536])
@pytest.mark.parametrize("num_buildings", [1, 8])
@pytest.mark.parametrize("height_m", [20.0, 0.5])
def test_more_layers_than_a_short_counter_holds(copies, num_buildings, height_m):
    # A counter of 16 bits would be back at zero; at half a metre every copy is clipped as well.
    sheet = np.array([[[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 9.0, 0.4]]])
    stack = np.repeat(sheet, copies // num_buildings, axis=0)
    scene = scene_of(*[stack] * num_buildings)
    camera = Camera(64, 48, 40.0, 40.0, 32.0, 24.0)
    once = ReferenceRenderer(scene_of(sheet)).render(camera, straight_down(height_m))
    assert once.any()
    np.testing.assert_array_equal(SilhouetteRenderer(scene, 1).render(camera, straight_down(height_m)), once)


def test_buildings_that_lost_all_their_triangles():
    # A building of one needle has no area in float32: it stays in the list, with nothing to draw.
    needle = np.array([[[5.0, 5.0, 5.0], [5.0, 5.0, 5.0], [6.0, 5.0, 5.0]]])
    scene = scene_of(needle, box([-3, -3, -3], [6, 6, 6]), needle)
    assert (np.diff(scene.triangle_starts) == 0).sum() == 2
    for height in (30.0, 3.0):
        assert assert_same(scene, Camera(64, 48, 40.0, 40.0, 32.0, 24.0), straight_down(height)).any()


RENDERERS = [ReferenceRenderer, lambda scene: SilhouetteRenderer(scene, 1)]


@pytest.mark.parametrize("make", RENDERERS, ids=["reference", "engine"])
class TestByHand:
    def test_a_unit_cube_from_above(self, make):
        # Its roof is 10 m below the camera: 40 px / 10 m, so 4 x 4 pixels right of and above the centre.
        mask = make(scene_of(box([0, 0, 0], [1, 1, 1]))).render(
            Camera(16, 16, 40, 40, 8, 8), straight_down(11.0)
        )
        expected = np.zeros((16, 16), dtype=bool)
        expected[4:8, 8:12] = True
        np.testing.assert_array_equal(mask, expected)

    @pytest.mark.parametrize("floor", [True, False])
    def test_roof_and_walls_of_a_cube_seen_aslant(self, make, floor):
        # Roof at 10 m: columns 40 to 80, rows 0 to 40 above the centre. Base at 20 m: columns 20 to
        # 40, rows 0 to 20. The outline between them runs along column = row, through pixel centres,
        # and as a left edge it keeps the pixels it meets.
        scene = scene_of(box([10, 0, 0], [10, 10, 10], floor=floor))
        mask = make(scene).render(Camera(100, 60, 40, 40, 0, 50), straight_down(20.0))
        expected = np.zeros((60, 100), dtype=bool)
        for above in range(40):
            expected[49 - above, max(20, above) : 80] = True
        np.testing.assert_array_equal(mask, expected)

    def test_the_inside_of_an_open_box_is_a_hole(self, make):
        # Four walls, no roof and no floor, from straight above: the opening at the base shows through.
        faces = box([-1, -1, 0], [2, 2, 10])
        normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
        walls = faces[normals[:, 2] == 0]
        mask = make(scene_of(walls)).render(Camera(32, 32, 40, 40, 16, 16), straight_down(20.0))
        expected = np.zeros((32, 32), dtype=bool)
        expected[12:20, 12:20] = True  # the rim, 40 px / 10 m * 1 m = 4 pixels each way
        expected[14:18, 14:18] = False  # the base, half as large
        np.testing.assert_array_equal(mask, expected)

    def test_neighbours_leave_no_gap_and_no_overlap(self, make):
        # Two triangles of a square whose corners lie on pixel centres: half-open edges give 8 x 8.
        square = np.array([[[0, 0, 0], [2, 0, 0], [2, 2, 0]], [[0, 0, 0], [2, 2, 0], [0, 2, 0]]], dtype=float)
        mask = make(scene_of(square)).render(Camera(24, 24, 40, 40, 8.5, 16.5), straight_down(10.0))
        expected = np.zeros((24, 24), dtype=bool)
        expected[8:16, 8:16] = True
        np.testing.assert_array_equal(mask, expected)

    def test_everything_behind_the_camera_is_empty(self, make):
        scene = scene_of(box([-5, -5, 30], [10, 10, 10]))
        assert not make(scene).render(Camera(20, 20, 10, 10, 10, 10), straight_down(20.0)).any()

    def test_a_wall_around_the_camera_fills_the_picture(self, make):
        scene = scene_of(box([-5, -5, -5], [10, 10, 10]))
        assert make(scene).render(Camera(70, 20, 10, 10, 35, 10), straight_down(0.0)).all()


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
