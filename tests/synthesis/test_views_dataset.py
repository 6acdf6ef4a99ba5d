"""`dataset=views`: seeded views of a city, as a dataset in the cache."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

import lodbench
from lodbench.citymodel import open_scene
from lodbench.errors import ConfigError, DatasetError
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.segmentation.masks import read_mask
from lodbench.synthesis.mask_degradation import mask_iou
from lodbench.synthesis.views import FINE_SIZE, RGB_CAMERA
from lodbench.synthesis.views_dataset import (
    Perturbation,
    ViewsParams,
    draw_queries,
    drawing_facts,
    open_views,
)
from tests.town import box_obj


@pytest.fixture(scope="module")
def city(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj())
    return path


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch) -> Path:
    folder = tmp_path_factory.getbasetemp() / "views-cache"
    monkeypatch.setenv("LODBENCH_CACHE", str(folder))
    return folder


def test_masks_are_as_wrong_as_asked(city):
    dataset, scene = open_views(ViewsParams(str(city), num_views=2)), open_scene(city)
    engine = SilhouetteRenderer(scene)
    for entry in dataset.entries:
        truth = dataset.truth[entry.key].shifted(-scene.origin)
        mask = read_mask(entry.mask) >= 0.5
        assert mask.shape == (448, 602)
        assert mask_iou(mask, engine.render(RGB_CAMERA.scaled(*FINE_SIZE), truth)) == pytest.approx(
            0.88, abs=0.005
        )


def test_priors_lie_in_the_asked_ranges(city):
    dataset = open_views(ViewsParams(str(city), num_views=2, range_m=4.0, height_m=2.0, tilt_deg=0.5))
    for entry in dataset.entries:
        truth = dataset.truth[entry.key]
        assert (np.abs(entry.prior.center - truth.center) <= np.array([4, 4, 2]) + 1e-9).all()
        assert (np.abs(np.subtract(entry.prior.euler, truth.euler))[:2] <= 0.5 + 1e-6).all()
    prior = ViewsParams(str(city), tilt_deg=0.7).prior("truth")
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
def test_ranges_that_cannot_be_are_told_before_the_city_is_read(setting):
    with pytest.raises(ConfigError, match=next(iter(setting))):
        ViewsParams("absent.gml", **setting)


def test_an_area_holds_what_its_views_look_at(city):
    scene = open_scene(city)
    middle_x = 0.5 * (scene.vertices[:, 0].min() + scene.vertices[:, 0].max())
    for area, sign in (("west", -1), ("east", 1)):
        for truth in open_views(ViewsParams(str(city), num_views=4, area=area)).truth.values():
            local, ray = truth.shifted(-scene.origin), truth.rotation[2]
            looked_at = local.center + ray * (local.center[2] / -ray[2])
            assert sign * (looked_at[0] - middle_x) > -15.0


def test_what_was_drawn_is_kept(city):
    params, scene = ViewsParams(str(city), num_views=2), open_scene(city)
    again, rejections = draw_queries(scene, SilhouetteRenderer(scene), params)
    assert drawing_facts(open_views(params)) == {"rejections": rejections, "mask_lod": scene.lod}
    assert len(again) == 2


def test_asking_for_more_keeps_the_first(city):
    few, more = (open_views(ViewsParams(str(city), num_views=n)) for n in (1, 2))
    assert few.root != more.root
    first = next(iter(few.truth))
    assert few.truth[first].cam_from_world.tolist() == more.truth[first].cam_from_world.tolist()


def test_the_same_settings_draw_nothing_again(city):
    root = open_views(ViewsParams(str(city), num_views=1)).root
    stamp = (root / "views" / "GT_pose.txt").stat().st_mtime_ns
    assert open_views(ViewsParams(str(city), num_views=1)).root == root
    assert (root / "views" / "GT_pose.txt").stat().st_mtime_ns == stamp


def test_photos_show_the_city_and_change_nothing_else(city):
    plain = open_views(ViewsParams(str(city), num_views=1))
    hard, again = (open_views(ViewsParams(str(city), num_views=1, look="hard", name=n)) for n in ("a", "b"))
    (entry,) = hard.entries
    assert hard.root == again.root != plain.root
    np.testing.assert_array_equal(read_mask(entry.mask), read_mask(plain.entries[0].mask))
    np.testing.assert_allclose(entry.prior.cam_from_world, plain.entries[0].prior.cam_from_world)
    photo = cv2.imread(str(entry.image))
    assert photo.shape == (entry.camera.height, entry.camera.width, 3)
    scene = open_scene(city)
    truth = hard.truth[entry.key].shifted(-scene.origin)
    seen = SilhouetteRenderer(scene).render(entry.camera, truth)
    inside, outside = (photo[part].mean(axis=0) for part in (seen, ~seen))
    assert np.abs(inside - outside).max() > 5.0


def test_photos_show_the_world_that_is_told(city):
    """A lens a third longer shows the buildings larger: of what both show one part only is roof and wall."""
    world = Perturbation(focal=0.3)
    longer = open_views(ViewsParams(str(city), num_views=1, look="hard", world=world))
    plain = open_views(ViewsParams(str(city), num_views=1, look="hard"))
    (entry,), scene = longer.entries, open_scene(city)
    assert entry.camera == plain.entries[0].camera
    truth, renderer = longer.truth[entry.key].shifted(-scene.origin), SilhouetteRenderer(scene)
    seen, told = (renderer.render(camera, truth) for camera in (world.lens(entry.camera, 0), entry.camera))
    photo, other = (cv2.imread(str(data.entries[0].image)).astype(float) for data in (longer, plain))
    for picture, right, wrong in ((photo, seen, told), (other, told, seen)):
        contrasts = [np.abs(picture[m].mean(axis=0) - picture[~m].mean(axis=0)).max() for m in (right, wrong)]
        assert contrasts[0] > contrasts[1]


def test_a_look_that_is_not_known_is_refused(city):
    with pytest.raises(ConfigError, match="no look hart"):
        open_views(ViewsParams(str(city), num_views=1, look="hart"))


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
def test_settings_out_of_range_are_refused(city, bad):
    with pytest.raises(ConfigError):
        ViewsParams(str(city), **bad)


def test_a_missing_city_is_one_line(tmp_path):
    with pytest.raises(DatasetError, match="does not exist"):
        open_views(ViewsParams(str(tmp_path / "no.obj")))


def test_measurements_are_as_wrong_as_stated_and_change_nothing_that_is_drawn(city):
    plain = open_views(ViewsParams(str(city), num_views=3))
    known = open_views(ViewsParams(str(city), num_views=3, rtk_m=0.2, laser_m=0.5))
    assert known.root == plain.root
    scene, errors = open_scene(city), []
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
