import numpy as np
import pytest

from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import EulerAngles, Pose
from lodbench.synthesis.views import (
    FINE_SIZE,
    RGB_CAMERA,
    ViewCheck,
    ViewSampling,
    sample_views,
    view_of,
)

CAMERA = RGB_CAMERA.scaled(*FINE_SIZE)


def test_rgb_camera_scales_to_the_fine_size():
    assert (CAMERA.width, CAMERA.height) == (602, 448)
    assert CAMERA.fx == pytest.approx(3778.423 * 602 / 5280)
    assert CAMERA.fy == pytest.approx(3767.392 * 448 / 3956)


def test_views_lie_in_the_asked_ranges(city, renderer):
    sampling = ViewSampling(camera_height_m=(100, 160), pitch_deg=(20, 60), building_share=(0.1, 0.8), seed=4)
    views = sample_views(city, renderer, CAMERA, sampling, 12, "test")
    assert len(views.poses) == 12
    assert views.rejections == renderer.calls - 12
    for pose in views.poses:
        pitch, roll, _ = pose.euler
        assert 20 <= pitch <= 60
        assert -1 <= roll <= 1
        assert 100 <= pose.center[2] - 20.0 <= 160
        assert 0.09 <= renderer.render(CAMERA, pose).mean() <= 0.82


def test_views_look_at_built_up_ground(city, renderer):
    check = ViewCheck(city, renderer, CAMERA, (0.0, 1.0))
    for pose in sample_views(city, renderer, CAMERA, ViewSampling(), 8, "aim").poses:
        axis = pose.rotation[2]
        hit = pose.center + axis * ((20.0 - pose.center[2]) / axis[2])
        assert np.linalg.norm(check.boxes.bases[:, :2] - hit[:2], axis=1).min() < 90


def test_more_views_keep_the_first_ones(city, renderer):
    few = sample_views(city, renderer, CAMERA, ViewSampling(), 3, "a").poses
    many = sample_views(city, renderer, CAMERA, ViewSampling(), 6, "a").poses
    for first, second in zip(few, many, strict=False):
        np.testing.assert_array_equal(first.cam_from_world, second.cam_from_world)
    other = sample_views(city, renderer, CAMERA, ViewSampling(), 1, "b").poses[0]
    assert np.abs(other.center - few[0].center).max() > 1e-3


def test_an_area_bounds_the_targets(city, renderer):
    check = ViewCheck(city, renderer, CAMERA, (0.0, 1.0))
    inside = check.buildings_in((0.0, 0.0, 100.0, 60.0))
    assert 0 < len(inside) < city.num_buildings
    with pytest.raises(DatasetError, match="no building"):
        sample_views(city, renderer, CAMERA, ViewSampling(area_m=(900, 900, 950, 950)), 1)


def test_hopeless_asks_stop_with_a_sentence(city, renderer):
    with pytest.raises(DatasetError, match="99%"):
        sample_views(city, renderer, CAMERA, ViewSampling(building_share=(0.99, 1.0)), 1)


def test_a_camera_among_buildings_is_not_clear(city, renderer):
    check = ViewCheck(city, renderer, CAMERA, (0.0, 1.0))
    down = EulerAngles(0.0, 0.0, 0.0)
    assert not check.accepts(Pose.from_euler(down, [10.0, 10.0, 35.0]))
    assert check.accepts(Pose.from_euler(down, [10.0, 10.0, 90.0]))


def test_view_of_meets_its_target():
    target = np.array([12.0, -7.0, 30.0])
    pose = view_of(target, 120.0, EulerAngles(50.0, 0.7, 33.0))
    assert pose.center[2] == pytest.approx(150.0)
    in_camera = pose.rotation @ target + pose.translation
    np.testing.assert_allclose(in_camera[:2], 0.0, atol=1e-9)
    assert in_camera[2] > 120.0


@pytest.mark.parametrize(
    "ranges",
    [{"pitch_deg": (60, 20)}, {"building_share": (0.1, 1.8)}, {"camera_height_m": (float("nan"), 160)}],
)
def test_bad_ranges_are_named(ranges):
    with pytest.raises(ConfigError, match=next(iter(ranges))):
        ViewSampling(**ranges)
