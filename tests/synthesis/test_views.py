"""Seeded views over a city, `dataset=views`, and worlds that differ from their map."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

import lodbench
from lodbench.citymodel import open_scene
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.geometry.camera import MAKER, distort
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.segmentation.masks import read_mask
from lodbench.synthesis.mask_degradation import mask_iou
from lodbench.synthesis.views import (
    FINE_SIZE,
    RGB_CAMERA,
    ViewCheck,
    ViewSampling,
    draw_through_lens,
    sample_views,
    view_of,
)
from lodbench.synthesis.views_dataset import (
    Perturbation,
    ViewsParams,
    draw_queries,
    drawing_facts,
    open_views,
)
from tests.town import box_obj

CAMERA = RGB_CAMERA.scaled(*FINE_SIZE)


def test_rgb_camera_scales_to_the_fine_size():
    assert (CAMERA.width, CAMERA.height) == (602, 448)
    assert CAMERA.fx == pytest.approx(3778.423 * 602 / 5280)
    assert CAMERA.fy == pytest.approx(3767.392 * 448 / 3956)


def test_views_lie_in_the_requested_ranges(city, renderer):
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


@pytest.fixture(scope="module")
def town(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj())
    return path


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch) -> Path:
    folder = tmp_path_factory.getbasetemp() / "views-cache"
    monkeypatch.setenv("LODBENCH_CACHE", str(folder))
    return folder


def test_masks_are_as_wrong_as_requested(town):
    dataset, scene = open_views(ViewsParams(str(town), num_views=2)), open_scene(town)
    engine = SilhouetteRenderer(scene)
    for entry in dataset.entries:
        truth = dataset.truth[entry.key].shifted(-scene.origin)
        mask = read_mask(entry.mask) >= 0.5
        assert mask.shape == (448, 602)
        assert mask_iou(mask, engine.render(RGB_CAMERA.scaled(*FINE_SIZE), truth)) == pytest.approx(
            0.88, abs=0.005
        )


def test_priors_lie_in_the_requested_ranges(town):
    dataset = open_views(ViewsParams(str(town), num_views=2, range_m=4.0, height_m=2.0, tilt_deg=0.5))
    for entry in dataset.entries:
        truth = dataset.truth[entry.key]
        assert (np.abs(entry.prior.center - truth.center) <= np.array([4, 4, 2]) + 1e-9).all()
        assert (np.abs(np.subtract(entry.prior.euler, truth.euler))[:2] <= 0.5 + 1e-6).all()
    prior = ViewsParams(str(town), tilt_deg=0.7).prior("truth")
    assert (prior.pitch_deg, prior.roll_deg) == (0.0, 0.0)


def test_a_lone_house_is_seen_from_lower_down(tmp_path):
    house = tmp_path / "house.obj"
    house.write_text(box_obj([(0, 0, 10, 8, 0, 6)]))
    with pytest.raises(DatasetError, match="200 views in a row") as fault:
        open_views(ViewsParams(str(house), num_views=1))
    assert "dataset.camera_height_m=" in fault.value.hint
    low = ViewsParams(str(house), num_views=3, camera_height_m=(30.0, 50.0), building_share=(0.02, 0.8))
    dataset = open_views(low)
    heights = [dataset.truth[entry.key].center[2] for entry in dataset.entries]
    assert len(heights) == 3
    assert all(30.0 <= height <= 50.0 for height in heights)


@pytest.mark.parametrize("setting", [{"camera_height_m": (80, 40)}, {"building_share": (0.5, 2.0)}])
def test_ranges_that_cannot_be_are_reported_before_the_city_is_read(setting):
    with pytest.raises(ConfigError, match=next(iter(setting))):
        ViewsParams("absent.gml", **setting)


def test_an_area_holds_what_its_views_look_at(town):
    scene = open_scene(town)
    middle_x = 0.5 * (scene.vertices[:, 0].min() + scene.vertices[:, 0].max())
    for area, sign in (("west", -1), ("east", 1)):
        for truth in open_views(ViewsParams(str(town), num_views=4, area=area)).truth.values():
            local, ray = truth.shifted(-scene.origin), truth.rotation[2]
            looked_at = local.center + ray * (local.center[2] / -ray[2])
            assert sign * (looked_at[0] - middle_x) > -15.0


def test_what_was_drawn_is_kept(town):
    params, scene = ViewsParams(str(town), num_views=2), open_scene(town)
    again, rejections = draw_queries(scene, SilhouetteRenderer(scene), params)
    assert drawing_facts(open_views(params)) == {"rejections": rejections, "mask_lod": scene.lod}
    assert len(again) == 2


def test_asking_for_more_keeps_the_first(town):
    few, more = (open_views(ViewsParams(str(town), num_views=n)) for n in (1, 2))
    assert few.root != more.root
    first = next(iter(few.truth))
    assert few.truth[first].cam_from_world.tolist() == more.truth[first].cam_from_world.tolist()


def test_the_same_settings_draw_nothing_again(town):
    root = open_views(ViewsParams(str(town), num_views=1)).root
    stamp = (root / "views" / "GT_pose.txt").stat().st_mtime_ns
    assert open_views(ViewsParams(str(town), num_views=1)).root == root
    assert (root / "views" / "GT_pose.txt").stat().st_mtime_ns == stamp


def test_photos_show_the_city_and_change_nothing_else(town):
    plain = open_views(ViewsParams(str(town), num_views=1))
    hard, again = (open_views(ViewsParams(str(town), num_views=1, look="hard", name=n)) for n in ("a", "b"))
    (entry,) = hard.entries
    assert hard.root == again.root != plain.root
    np.testing.assert_array_equal(read_mask(entry.mask), read_mask(plain.entries[0].mask))
    np.testing.assert_allclose(entry.prior.cam_from_world, plain.entries[0].prior.cam_from_world)
    photo = cv2.imread(str(entry.image))
    assert photo.shape == (entry.camera.height, entry.camera.width, 3)
    scene = open_scene(town)
    truth = hard.truth[entry.key].shifted(-scene.origin)
    seen = SilhouetteRenderer(scene).render(entry.camera, truth)
    inside, outside = (photo[part].mean(axis=0) for part in (seen, ~seen))
    assert np.abs(inside - outside).max() > 5.0


def test_photos_show_the_world_that_is_reported(town):
    """A lens a third longer shows the buildings larger: of what both show one part only is roof and wall."""
    world = Perturbation(focal=0.3)
    longer = open_views(ViewsParams(str(town), num_views=1, look="hard", world=world))
    plain = open_views(ViewsParams(str(town), num_views=1, look="hard"))
    (entry,), scene = longer.entries, open_scene(town)
    assert entry.camera == plain.entries[0].camera
    truth, renderer = longer.truth[entry.key].shifted(-scene.origin), SilhouetteRenderer(scene)
    seen, told = (renderer.render(camera, truth) for camera in (world.lens(entry.camera, 0), entry.camera))
    photo, other = (cv2.imread(str(data.entries[0].image)).astype(float) for data in (longer, plain))
    for picture, right, wrong in ((photo, seen, told), (other, told, seen)):
        contrasts = [np.abs(picture[m].mean(axis=0) - picture[~m].mean(axis=0)).max() for m in (right, wrong)]
        assert contrasts[0] > contrasts[1]


def test_a_look_that_is_not_known_is_refused(town):
    with pytest.raises(ConfigError, match="no look hart"):
        open_views(ViewsParams(str(town), num_views=1, look="hart"))


@pytest.mark.parametrize(
    "bad",
    [
        {"num_views": 0},
        {"mask_iou": 0.0},
        {"mask_iou": 1.5},
        {"tilt_deg": -1.0},
        {"tilt_deg": math.nan},
        {"area": "middle"},
    ],
)
def test_settings_out_of_range_are_refused(town, bad):
    with pytest.raises(ConfigError):
        ViewsParams(str(town), **bad)


def test_a_missing_city_is_one_line(tmp_path):
    with pytest.raises(DatasetError, match="does not exist"):
        open_views(ViewsParams(str(tmp_path / "no.obj")))


def test_measurements_are_as_wrong_as_stated_and_change_nothing_that_is_drawn(town):
    plain = open_views(ViewsParams(str(town), num_views=3))
    known = open_views(ViewsParams(str(town), num_views=3, rtk_m=0.2, laser_m=0.5))
    assert known.root == plain.root
    scene, errors = open_scene(town), []
    for before, entry in zip(plain.entries, known.entries, strict=True):
        truth = known.truth[entry.key]
        assert (before.measured, entry.hypotheses) == (None, (entry.prior,))
        assert entry.measured.sigmas == (0.2, 0.2, 0.2, None, None, None)
        np.testing.assert_allclose(entry.prior.rotation, before.prior.rotation, atol=1e-12)
        errors.append((entry.prior.center - truth.center) / 0.2)
        middle = [0.5 * entry.camera.width, 0.5 * entry.camera.height]
        met = lodbench.locate(scene, entry.camera, truth, middle)
        errors.append([(entry.measured.laser.range_m - np.linalg.norm(met.place - truth.center)) / 0.5])
        assert entry.measured.laser.sigma_m == 0.5
    errors = np.concatenate(errors)
    assert 0.3 < errors.std() < 2.0
    assert np.abs(errors).max() < 4.0


def heights(scene):
    """Returns the floor and the top of each building, metres."""
    parts = [scene.vertices[first:last, 2] for first, last in pairwise(scene.vertex_starts)]
    return np.array([[part.min(), part.max()] for part in parts])


def test_roofs_rise_together_and_feet_are_cut(town):
    scene = open_scene(town)
    before = heights(scene)
    after = heights(Perturbation(shared_roofs_m=1.5, hidden_feet_m=2.0).perturbed(scene))
    np.testing.assert_allclose(after - before, np.broadcast_to([2.0, 1.5], before.shape), atol=1e-4)
    assert Perturbation().perturbed(scene) is scene


def test_lenses_are_longer_and_shorter_in_turn():
    world = Perturbation(focal=0.03)
    stretches = [world.lens(RGB_CAMERA, view).fx / RGB_CAMERA.fx for view in range(4)]
    assert stretches == pytest.approx([1.03, 0.97, 1.03, 0.97])


def test_a_world_is_reported_in_short():
    world = Perturbation.parse("shared_roofs=1.5,hidden_feet_m=2,focal=0.01,tilt=5")
    assert world == Perturbation(1.5, 2.0, 0.01, 5.0)
    assert world.describe() == "shared_roofs_m=1.5, hidden_feet_m=2, focal=0.01, tilt=5"
    assert Perturbation.parse("") == Perturbation()


@pytest.mark.parametrize(
    ("text", "words"),
    [("roofs=1", "roofs"), ("focal=long", "world.focal"), ("focal=2", "within"), ("tilt=nan", "within")],
)
def test_what_is_no_world(text, words):
    with pytest.raises(ConfigError, match=words):
        Perturbation.parse(text)


def test_views_of_a_world_stand_where_those_of_the_map_do(town):
    plain = open_views(ViewsParams(str(town), num_views=2, mask_iou=1.0))
    wrong = open_views(
        ViewsParams(
            str(town), num_views=2, mask_iou=1.0, world=Perturbation(hidden_feet_m=1.0, focal=0.02, tilt=5.0)
        )
    )
    for before, after in zip(plain.entries, wrong.entries, strict=True):
        truth = plain.truth[before.key]
        np.testing.assert_array_equal(truth.cam_from_world, wrong.truth[after.key].cam_from_world)
        # The lens that is told is the same; what is seen is not.
        assert before.camera == after.camera
        assert (read_mask(before.mask) != read_mask(after.mask)).any()
        errors = [np.subtract(entry.prior.euler, truth.euler)[:2] for entry in (before, after)]
        np.testing.assert_allclose(errors[1], 5.0 * errors[0], atol=1e-6)


def test_principal_points_are_aside_in_turn():
    world = Perturbation(center=0.01)
    aside = [
        (lens.cx - RGB_CAMERA.cx, lens.cy - RGB_CAMERA.cy)
        for lens in (world.lens(RGB_CAMERA, i) for i in range(4))
    ]
    px = 0.01 * RGB_CAMERA.width
    assert aside == [pytest.approx(at) for at in ((px, 0), (0, px), (-px, 0), (0, -px))]


@pytest.mark.parametrize("k1", [-0.15, -0.05, 0.05])
def test_a_lens_shows_points_where_its_formula_puts_them(k1):
    lens = replace(Camera(600, 400, 500, 500, 300, 200), distortion=(k1, 0, 0, 0))

    def draw(pinhole):
        columns, rows = np.meshgrid(np.arange(600) + 0.5, np.arange(400) + 0.5)
        rays = ((columns - pinhole.cx) / pinhole.fx, (rows - pinhole.cy) / pinhole.fy)
        return np.stack([*rays, np.zeros_like(columns)], axis=-1).astype(np.float32)

    shown = draw_through_lens(draw, lens)[2:-2, 2:-2]
    x, y = distort(lens.lens, lens.distortion, *np.moveaxis(shown[..., :2].astype(float), -1, 0))
    columns, rows = np.meshgrid(np.arange(2, 598) + 0.5, np.arange(2, 398) + 0.5)
    np.testing.assert_allclose(500 * x + 300, columns, atol=0.05)
    np.testing.assert_allclose(500 * y + 200, rows, atol=0.05)


def test_masks_through_a_lens_keep_their_values():
    lens = replace(Camera(60, 40, 50, 50, 30, 20), distortion=(-0.1, 0, 0, 0))
    labels = np.random.default_rng(0).integers(-1, 5, (40, 60), dtype=np.int32)
    shown = draw_through_lens(lambda _: labels, lens)
    assert shown.dtype == labels.dtype
    assert shown.shape == (40, 60)
    assert np.isin(shown, labels).all()


def test_a_stated_camera_is_known_as_well_as_its_source_says(town):
    entries = open_views(ViewsParams(str(town), num_views=2, camera_source="maker")).entries
    assert {entry.camera_sigmas for entry in entries} == {MAKER}
    with pytest.raises(ConfigError, match="camera_source is one of calibration, maker, nominal"):
        ViewsParams(str(town), camera_source="guess")
