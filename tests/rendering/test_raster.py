"""The raster covers what the engine does and says what pixels show; textured planes are as projected."""

import cv2
import numpy as np
import pytest
from hostile_scenes import (
    KINDS,
    SIZES,
    box,
    cast_rays,
    hostile_scenes,
    hostile_views,
    scene_of,
    straight_down,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lodbench.citymodel.textured_map import TexturedMesh, join_textured
from lodbench.errors import RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotation_from_euler
from lodbench.rendering.backends import PyrenderTextured
from lodbench.rendering.raster import RasterRenderer, TexturedRenderer, grouped_scene, triangle_groups
from lodbench.rendering.reference import ReferenceRenderer
from lodbench.rendering.silhouette import SilhouetteRenderer

CAMERA = Camera(130, 97, 80.0, 71.0, 60.0, 52.0)


def draw(scene, camera, pose):
    """Draws with the raster, having compared its mask with the engine's and the reference's."""
    raster = RasterRenderer(scene, 1)
    layers = raster.draw(camera, pose)
    np.testing.assert_array_equal(layers.mask, ReferenceRenderer(scene).render(camera, pose))
    np.testing.assert_array_equal(layers.mask, SilhouetteRenderer(scene, 1).render(camera, pose))
    np.testing.assert_array_equal(layers.mask, raster.render(camera, pose))
    np.testing.assert_array_equal(layers.depth, raster.depth(camera, pose))
    return layers


def assert_layers_agree(scene, layers):
    """Every layer is empty on the same pixels, and a triangle belongs to its building."""
    seen = layers.mask
    assert (layers.depth > 0).tolist() == seen.tolist()
    assert (layers.building >= 0).tolist() == seen.tolist()
    starts = scene.triangle_starts[layers.building[seen]], scene.triangle_starts[layers.building[seen] + 1]
    assert ((starts[0] <= layers.triangle[seen]) & (layers.triangle[seen] < starts[1])).all()
    assert not layers.normal[~seen].any()
    assert np.isfinite(layers.depth).all()


@pytest.mark.slow
@settings(max_examples=120, suppress_health_check=[HealthCheck.too_slow])
@given(hostile_scenes(), hostile_views())
def test_on_hostile_triangles(scene, view):
    assert_layers_agree(scene, draw(scene, *view))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__.strip("_"))
def test_on_each_kind_of_triangle(kind):
    for seed, tilt_deg, distance in ((0, 0.0, 40.0), (1, 35.0, 90.0), (2, 90.0, 2.0)):
        rotation = rotation_from_euler(EulerAngles(tilt_deg, 3.0, 20.0))
        scene = scene_of(kind(np.random.default_rng(seed)), box([-3, -3, -3], [6, 6, 6]))
        layers = draw(scene, CAMERA, Pose.from_center(rotation, -distance * rotation[2]))
        assert layers.mask.any()
        assert_layers_agree(scene, layers)


@pytest.mark.parametrize(("width", "height"), [*SIZES, (8192, 1), (1, 8192), (301, 224)])
def test_at_every_image_size(width, height):
    scene = scene_of(box([-30, -30, 0], [25, 70, 20]), box([0, -5, 0], [9, 9, 30], floor=False))
    camera = Camera(width, height, 0.6 * width, 0.6 * height, width / 2, height / 2)
    assert draw(scene, camera, Pose.from_euler(EulerAngles(20, 1, 33), (10, -30, 90))).mask.any()


@pytest.mark.parametrize("floor", [True, False])
@pytest.mark.parametrize(
    "center", [(5, 5, 5), (5, 5, -8), (0, 0, 0), (10.05, 5, 5), (5, 5, 10.1), (5, 5, 10)]
)
def test_camera_inside_below_and_on_a_building(center, floor):
    scene = scene_of(box([0, 0, 0], [10, 10, 10], floor=floor))
    for pitch in (0.0, 60.0, 90.0, 130.0, 180.0):
        pose = Pose.from_euler(EulerAngles(pitch, 2.0, 77.0), center)
        assert_layers_agree(scene, draw(scene, CAMERA, pose))


@pytest.mark.parametrize("seed", range(6))
def test_against_rays(seed):
    # Rays know no pixels: compare where the nearest hit is well inside its triangle.
    rng = np.random.default_rng(seed)
    scene = scene_of(
        rng.uniform(-40, 40, (12, 3, 3)),
        box(rng.uniform(-20, 0, 3), rng.uniform(5, 20, 3)),
        box([0] * 3, [9] * 3),
    )
    rotation = rotation_from_euler(EulerAngles(*rng.uniform([0, -20, -180], [110, 20, 180])))
    pose = Pose.from_center(rotation, -rng.choice([3.0, 60.0]) * rotation[2])
    layers, hits = draw(scene, CAMERA, pose), cast_rays(scene, CAMERA, pose)
    sure = hits.is_sure
    assert sure.mean() > 0.05
    np.testing.assert_array_equal(layers.triangle[sure], hits.triangle[sure])
    np.testing.assert_allclose(layers.depth[sure], hits.depth[sure], rtol=2e-7)


def test_depth_ids_and_normals_by_hand():
    # A low and a high box from straight above: roofs 50 and 30 m below the camera.
    scene = scene_of(box([-8, -8, 0], [16, 16, 10]), box([-2, -2, 0], [4, 4, 30]))
    camera = Camera(64, 64, 100.0, 100.0, 32.0, 32.0)
    layers = draw(scene, camera, straight_down(60.0))
    assert layers.depth[32, 32] == 30.0
    assert layers.depth[32, 20] == 50.0
    assert layers.depth[2, 2] == 0.0
    assert (layers.building[32, 32], layers.building[32, 20], layers.building[2, 2]) == (1, 0, -1)
    assert layers.normal[32, 32].tolist() == [0.0, 0.0, 1.0]
    assert (layers.colour[32, 32] != layers.colour[2, 2]).any()


@pytest.mark.parametrize("flip", [False, True])
def test_normals_face_the_camera_whatever_the_winding(flip):
    roof = np.array([[[-5.0, -5.0, 0.0], [5.0, -5.0, 0.0], [0.0, 5.0, 0.0]]])
    scene = scene_of(roof[:, ::-1] if flip else roof)
    above = RasterRenderer(scene, 1).draw(CAMERA, straight_down(20.0))
    assert above.normal[above.mask].tolist() == [[0.0, 0.0, 1.0]] * int(above.mask.sum())
    below = RasterRenderer(scene, 1).draw(CAMERA, Pose.from_euler(EulerAngles(180, 0, 0), (0, 0, -20)))
    assert below.mask.any()
    assert below.normal[below.mask].tolist() == [[0.0, 0.0, -1.0]] * int(below.mask.sum())


def test_of_equal_faces_the_first_wins():
    # The same face, from each of its corners and turned over: rounding must not mix them.
    rng = np.random.default_rng(3)
    for _ in range(20):
        face = rng.uniform(-30, 30, (3, 3))
        copies = np.array([face, face[[1, 2, 0]], face[[2, 0, 1]], face[::-1], face[[1, 0, 2]]])
        scene = scene_of(copies, copies[::-1])
        rotation = rotation_from_euler(EulerAngles(rng.uniform(0, 90), 0, rng.uniform(-180, 180)))
        layers = draw(scene, CAMERA, Pose.from_center(rotation, -80.0 * rotation[2]))
        assert set(np.unique(layers.triangle)) <= {-1, 0}


def test_threads_change_nothing():
    rng = np.random.default_rng(5)
    scene = scene_of(*[box(rng.uniform(-60, 40, 3), rng.uniform(2, 30, 3)) for _ in range(40)])
    camera = Camera(333, 200, 210.0, 190.0, 150.0, 110.0)
    pose = Pose.from_euler(EulerAngles(40, 1, 12), (0, -60, 90))
    one, three = (RasterRenderer(scene, threads).draw(camera, pose) for threads in (1, 3))
    for name in ("depth", "building", "triangle", "normal", "colour"):
        assert getattr(one, name).tobytes() == getattr(three, name).tobytes(), name


def test_instances_share_out_the_silhouette():
    rng = np.random.default_rng(8)
    scene = scene_of(*[box(rng.uniform(-30, 20, 3), rng.uniform(2, 20, 3)) for _ in range(12)])
    layers = draw(scene, CAMERA, Pose.from_euler(EulerAngles(50, 1, 12), (0, -60, 60)))
    masks = layers.instance_masks()
    assert 1 < len(masks) <= 12
    assert list(masks) == sorted(masks)
    np.testing.assert_array_equal(np.sum(list(masks.values()), axis=0), layers.mask)


def test_a_scene_that_may_not_be_written_to():
    # As one mapped from the cache.
    scene = scene_of(box([-5, -5, 0], [10, 10, 10]), box([12, 0, 0], [4, 9, 20]))
    expected = draw(scene, CAMERA, straight_down(60.0))
    for array in (scene.vertices, scene.triangles, scene.vertex_starts, scene.triangle_starts):
        array.flags.writeable = False
    found = RasterRenderer(scene, 1).draw(CAMERA, straight_down(60.0))
    np.testing.assert_array_equal(found.colour, expected.colour)
    np.testing.assert_array_equal(found.depth, expected.depth)


def test_nothing_in_view_is_empty_everywhere():
    scene = scene_of(box([-5, -5, 30], [10, 10, 10]))
    layers = draw(scene, CAMERA, straight_down(20.0))
    assert not layers.mask.any()
    assert not layers.depth.any()
    assert len(np.unique(layers.colour.reshape(-1, 3), axis=0)) == 1


@pytest.mark.slow
def test_real_quarters(real_quarter):
    scene, place = real_quarter
    camera = Camera(101, 75, 72.0, 61.0, 41.0, 46.0)
    for pitch, yaw, distance in ((0, 10, 120), (45, 130, 150), (75, -60, 100), (90, 200, 4)):
        rotation = rotation_from_euler(EulerAngles(pitch, 0.7, yaw))
        layers = draw(scene, camera, Pose.from_center(rotation, place - distance * rotation[2]))
        assert layers.mask.any()
        assert_layers_agree(scene, layers)


@pytest.mark.parametrize(
    "camera", [Camera(64, 48, 40, 40, 32, 24, (0.1, 0.0, 0.0, 0.0)), Camera(8193, 8, 40, 40, 32, 24)]
)
def test_a_camera_it_cannot_render_is_refused(camera):
    with pytest.raises(RenderingError):
        RasterRenderer(scene_of(box([0, 0, 0], [1, 1, 1])), 1).draw(camera, straight_down(5.0))


TEXTURED_CAMERA = Camera(200, 160, 190.0, 195.0, 101.0, 78.0)
POSE = Pose.from_euler(EulerAngles(35.0, 2.0, 20.0), [12.0, -45.0, 95.0])
# A square of ground, 120 m wide, with a picture on it.
SIZE_M, PIXELS = 120.0, 256


def smooth_picture():
    y, x = np.mgrid[0:PIXELS, 0:PIXELS] / (PIXELS - 1.0)
    waves = 0.5 + 0.3 * np.sin(9 * x + 4 * y)
    return (255 * np.stack([0.15 + 0.7 * x, 0.15 + 0.7 * y, waves], axis=2)).astype(np.uint8)


def ground(picture, size_m=SIZE_M, height_m=0.0, repeats=1.0) -> TexturedMesh:
    half = size_m / 2
    corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    corners = np.column_stack([corners, np.full(4, height_m)])
    uv = repeats * np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    faces = np.array([(0, 1, 2), (0, 2, 3)])
    none = np.zeros((2, 3, 3), np.uint8)
    return TexturedMesh(corners[faces], uv[faces], np.zeros(2, np.int32), none, (picture,))


def textured_draw(mesh, pose=POSE, camera=TEXTURED_CAMERA, threads=1):
    return TexturedRenderer(mesh, threads).colours(camera, pose.rotation[None], pose.center[None])[0]


def test_perspective_is_that_of_the_plane():
    to_ground = np.array([[SIZE_M / PIXELS, 0, -SIZE_M / 2], [0, -SIZE_M / PIXELS, SIZE_M / 2], [0, 0, 1.0]])
    plane = np.column_stack([POSE.rotation[:, 0], POSE.rotation[:, 1], POSE.translation])
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    view = np.linalg.inv(shift) @ TEXTURED_CAMERA.matrix @ plane @ to_ground @ shift
    size = (TEXTURED_CAMERA.width, TEXTURED_CAMERA.height)
    expected = cv2.warpPerspective(smooth_picture(), view, size, flags=cv2.INTER_LINEAR)
    covered = cv2.warpPerspective(np.ones((PIXELS, PIXELS), np.uint8), view, size, flags=cv2.INTER_NEAREST)
    covered = cv2.erode(covered, np.ones((5, 5), np.uint8)) > 0
    assert covered.mean() > 0.4
    off = np.abs(textured_draw(ground(smooth_picture())).astype(float) - expected)[covered]
    assert off.mean() < 1.0
    assert np.percentile(off, 99) < 4.0


def test_a_far_view_of_a_fine_pattern_is_grey_not_moire():
    # Squares of one texel, a hundred of which fall into a pixel.
    squares = np.indices((PIXELS, PIXELS)).sum(axis=0) % 2
    picture = np.repeat((255 * squares)[:, :, None], 3, axis=2).astype(np.uint8)
    far = Pose.from_euler(EulerAngles(0.0, 0.0, 30.0), [0.0, 0.0, 400.0])
    seen = textured_draw(ground(picture, repeats=20.0), far)
    depth = TexturedRenderer(ground(picture), 1).depths(
        TEXTURED_CAMERA, far.rotation[None], far.center[None]
    )[0]
    inside = cv2.erode((depth > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert inside.sum() > 1000
    assert np.abs(seen[inside].astype(float) - 127.5).max() < 12


def test_the_nearer_surface_hides_the_other_and_nothing_is_pale():
    red = np.broadcast_to(np.array([200, 10, 10], np.uint8), (8, 8, 3)).copy()
    below = ground(smooth_picture())
    both = join_textured([below, ground(red, 30.0, 20.0)])
    down = Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), [0.0, 0.0, 100.0])
    seen, alone = textured_draw(both, down), textured_draw(below, down)
    assert (np.abs(seen[75:82, 98:104].astype(int) - [200, 10, 10]) <= 1).all()
    outside = np.ones(seen.shape[:2], dtype=bool)
    outside[30:125, 50:150] = False
    np.testing.assert_array_equal(seen[outside], alone[outside])
    up = Pose.from_euler(EulerAngles(180.0, 0.0, 0.0), [0.0, 0.0, 100.0])
    assert len(np.unique(textured_draw(both, up).reshape(-1, 3), axis=0)) == 1


def test_colours_of_corners_are_blended_over_their_triangle():
    corners = np.array([[(-500.0, -500.0, 0.0), (500.0, -500.0, 0.0), (0.0, 800.0, 0.0)]])
    colours = np.array([[(200, 100, 50)] * 3], dtype=np.uint8)
    mesh = TexturedMesh(corners, np.zeros((1, 3, 2)), np.array([-1], np.int32), colours, ())
    np.testing.assert_allclose(textured_draw(mesh)[80, 100], [200, 100, 50], atol=1)


@pytest.mark.parametrize("count", [1, 5])
def test_batches_and_threads_change_nothing(count):
    rng = np.random.default_rng(count)
    mesh = join_textured([ground(smooth_picture(), 40.0, float(z)) for z in rng.uniform(0, 30, 5)])
    yaws = rng.uniform(0, 360, count)
    rotations = np.array([rotation_from_euler(EulerAngles(30.0, 0.0, yaw)) for yaw in yaws])
    centers = -90 * rotations[:, 2]
    whole = TexturedRenderer(mesh, 3).colours(TEXTURED_CAMERA, rotations, centers)
    single = TexturedRenderer(mesh, 1)
    for i in range(count):
        np.testing.assert_array_equal(
            single.colours(TEXTURED_CAMERA, rotations[[i]], centers[[i]])[0], whole[i]
        )
    assert len(np.unique(whole[0].reshape(-1, 3), axis=0)) > 100


@pytest.mark.slow
def test_pyrender_draws_the_same():
    pytest.importorskip("pyrender")
    try:
        theirs = PyrenderTextured(ground(smooth_picture())).colours(
            TEXTURED_CAMERA, POSE.rotation[None], POSE.center[None]
        )[0]
    except RenderingError as error:
        pytest.skip(str(error))
    off = np.abs(theirs.astype(int) - textured_draw(ground(smooth_picture()))).max(axis=2)
    assert np.median(off) <= 1
    assert (off > 12).mean() < 0.03


@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
def test_a_scene_has_the_triangles_and_each_vertex_once(seed, count):
    """Corners on whole metres, so that many are shared, within a group and beyond it."""
    rng = np.random.default_rng(seed)
    corners = (rng.integers(-40, 40, (count, 1, 3)) + rng.integers(-1, 2, (count, 3, 3))).astype(np.float64)
    order, starts = triangle_groups(corners)
    corners = corners[order]
    scene = grouped_scene(corners, starts)
    np.testing.assert_array_equal(scene.vertices[scene.triangles], corners)
    np.testing.assert_array_equal(scene.triangle_starts, starts)
    for group in range(scene.num_buildings):
        (v, w), (t, u) = scene.vertex_starts[group : group + 2], starts[group : group + 2]
        expected = np.unique(corners[t:u].reshape(-1, 3), axis=0)
        np.testing.assert_array_equal(scene.vertices[v:w], expected)


def test_neighbours_are_in_one_group_and_far_ones_are_not():
    near, far = np.zeros((2, 3, 3)), np.full((1, 3, 3), 500.0)
    _, starts = triangle_groups(np.concatenate([near, far]))
    assert starts.tolist() == [0, 2, 3]


def test_no_triangle_makes_no_building():
    scene = grouped_scene(np.zeros((0, 3, 3)), np.zeros(1, dtype=np.int64))
    assert (scene.num_buildings, len(scene.vertices), len(scene.triangles)) == (0, 0, 0)
