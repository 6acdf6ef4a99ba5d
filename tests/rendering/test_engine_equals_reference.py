"""The engine and the numpy reference agree on every pixel, whatever the triangles and the camera."""

import numpy as np
import pytest
from hostile_scenes import KINDS, SIZES, box, hostile_scenes, hostile_views, scene_of, straight_down
from hypothesis import HealthCheck, given, settings

from lodbench.geometry import Camera, EulerAngles, Pose, rotation_from_euler
from lodbench.rendering.reference import ReferenceRenderer
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
