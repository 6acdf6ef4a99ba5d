"""Map-guided masks: silhouettes found again where they were moved from, outlines cut along edges."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, QueryFault
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.segmentation import MapGuidedSegmenter, notes_of
from lodbench.segmentation.map_guided import (
    MapGuided,
    MapGuidedParams,
    aligned,
    cut,
    exactness,
    guided_mask,
    held_out_evidence,
    margin_px,
    moved,
    without_map,
)
from tests.town import box_obj

SHAPE = (225, 300)
PARAMS = MapGuidedParams()


def iou(first, second):
    return (first & second).sum() / (first | second).sum()


def houses():
    """Returns a mask of three houses, one L-shaped, none symmetric with another."""
    mask = np.zeros(SHAPE, np.uint8)
    cv2.fillPoly(mask, [np.array([[60, 50], [120, 40], [126, 76], [66, 86]])], 1)
    cv2.fillPoly(
        mask, [np.array([[170, 120], [240, 120], [240, 150], [205, 150], [205, 185], [170, 185]])], 1
    )
    cv2.rectangle(mask, (80, 150), (110, 190), 1, -1)
    return mask.astype(bool)


def photo_of(mask, seed=0):
    """Returns an RGB photo: roofs of two colours on meadow, with trees like neither, and noise everywhere."""
    generator = np.random.default_rng(seed)
    photo = np.empty((*SHAPE, 3), np.float32)
    photo[:] = (90, 120, 60)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    for x, y in generator.uniform((0, 0), SHAPE[::-1], (12, 2)):
        photo[np.hypot(columns - x, rows - y) < 9] = (40, 70, 35)
    photo[mask & (columns < 140)] = (170, 90, 70)
    photo[mask & (columns >= 140)] = (120, 120, 125)
    photo += generator.normal(0, 8, photo.shape)
    return np.clip(photo, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def photo():
    return photo_of(houses())


@pytest.mark.parametrize("motion", [(9.0, -5.0, 2.0), (-18.0, 11.0, -4.0), (0.0, 0.0, 0.0)])
def test_a_moved_silhouette_is_found_again(photo, motion):
    guide = np.pad(moved(np.pad(houses(), 60), np.array([*motion, 0.0]), SHAPE[::-1]), 45, mode="edge")
    best, *others = aligned(photo[..., ::-1], guide, 30.0, 6.0, count=3)
    assert iou(best.mask, houses()) > 0.93
    assert best.motion[2] == pytest.approx(-motion[2], abs=0.7)
    assert all(other.fit < best.fit for other in others)


def test_a_motion_is_about_the_centre():
    mask = np.zeros((101, 201), bool)
    mask[40:61, 80:121] = True
    assert np.array_equal(moved(np.pad(mask, 10), np.zeros(4), (201, 101)), mask)
    shifted = moved(np.pad(mask, 10), np.array([7.0, -3.0, 0.0, 0.0]), (201, 101))
    assert np.array_equal(shifted, np.roll(mask, (-3, 7), (0, 1)))
    upright = moved(np.pad(mask, 10), np.array([0.0, 0.0, 90.0, 0.0]), (201, 101))
    assert np.array_equal(np.argwhere(upright).min(axis=0), [30, 90])


def test_a_cut_follows_the_photo_where_the_silhouette_is_rough(photo):
    rough = cv2.dilate(houses().astype(np.uint8), np.ones((7, 7)))
    rough[120:150, 205:225] = 0
    before, after = iou(rough > 0, houses()), iou(cut(photo[..., ::-1], rough > 0) >= 0.5, houses())
    assert before < 0.72
    assert after > before + 0.12


def test_a_true_outline_is_kept_and_known_to_be_exact(photo):
    bgr = photo[..., ::-1]
    assert iou(cut(bgr, houses()) >= 0.5, houses()) > 0.97
    assert exactness(bgr, houses()) > 1.5 > 1.2 > exactness(bgr, np.roll(houses(), (5, 5), (0, 1)))


def test_evidence_is_assessed_by_other_pixels(photo):
    bgr = photo[..., ::-1]
    noise = np.random.default_rng(3).integers(0, 256, bgr.shape, dtype=np.uint8)
    assert held_out_evidence(bgr, houses()) > 0.2
    # Where the silhouette has nothing to do with the photo, histograms of one half tell nothing of the other.
    assert held_out_evidence(noise, houses()) < 0.0


def test_a_guided_mask_is_better_than_its_guide_and_keeps_the_second(photo):
    silhouette = moved(np.pad(houses(), 60), np.array([6.0, 9.0, -3.0, 0.0]), SHAPE[::-1])
    found = guided_mask(photo, [without_map(silhouette, photo, PARAMS)], PARAMS)
    assert iou(silhouette, houses()) < 0.6
    assert iou(found.probability >= 0.5, houses()) > 0.93
    assert found.evidence > 0.2
    if found.second is not None:
        assert found.ahead > 0
        assert found.second.shape == found.probability.shape
    again = guided_mask(photo, [without_map(silhouette, photo, PARAMS)], PARAMS)
    assert np.array_equal(found.probability, again.probability)


def test_a_guide_reaches_beyond_the_photo():
    mask = np.zeros((90, 120), bool)
    mask[:, :10] = True
    guide = without_map(mask, np.zeros((90, 120, 3), np.uint8), MapGuidedParams(size=120))
    margin = margin_px(MapGuidedParams(size=120), 120, 90)
    assert guide.shape == (90 + 2 * margin, 120 + 2 * margin)
    assert guide[0, : margin + 10].all()
    assert not guide[:, margin + 10 :].any()


CAMERA = Camera(400, 300, 320.0, 320.0, 200.0, 150.0)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj())
    return open_scene(path)


@pytest.fixture(scope="module")
def view(town, tmp_path_factory):
    x, y = town.vertices[:, :2].mean(axis=0)
    truth = Pose.from_euler(EulerAngles(0.0, 0.0, 20.0), (float(x), float(y), 160.0))
    mask = CityMap(town).render(CAMERA, truth)
    photo = np.where(mask[..., None], (70, 90, 170), (60, 120, 90)) + np.random.default_rng(1).normal(
        0, 9, (300, 400, 3)
    )
    path = tmp_path_factory.mktemp("view") / "photo.png"
    cv2.imwrite(str(path), np.clip(photo, 0, 255).astype(np.uint8))
    return truth, mask, path


class TestFromTheMap:
    """Views straight down on the tests' town, painted: what the segmenter finds from a wrong prior."""

    def entry(self, path, camera=CAMERA):
        return Entry("photo.png", "test", camera, None, path, None)

    @pytest.mark.slow
    def test_a_wrong_prior_still_gives_the_mask(self, town, view):
        truth, mask, path = view
        segmenter, city_map = MapGuided(PARAMS), CityMap(town)
        assert isinstance(segmenter, MapGuidedSegmenter)
        prior = Pose.from_euler(truth.euler._replace(yaw_deg=24.0), truth.shifted([9.0, -7.0, 12.0]).center)
        found = segmenter.segment_from(self.entry(path), prior, city_map)
        large = cv2.resize(found, mask.shape[::-1]) >= 0.5
        before = iou(city_map.render(CAMERA, prior), mask)
        assert iou(large, mask) > max(0.9, before + 0.2)
        assert "guided by the map" in notes_of(segmenter)[0]

    def test_where_there_is_nothing_to_be_guided_by(self, town, view):
        truth, _, path = view
        segmenter, city_map = MapGuided(PARAMS), CityMap(town)
        away = truth.shifted([5000.0, 0.0, 0.0])
        for entry, pose, words in (
            (self.entry(path), away, "no building of the map"),
            (self.entry(None), truth, "no photo"),
            (self.entry(path, None), truth, "no camera"),
            (self.entry(Path("nowhere.png")), truth, "cannot be read"),
        ):
            with pytest.raises(QueryFault, match=words):
                segmenter.segment_from(entry, pose, city_map)
        with pytest.raises(QueryFault, match="needs a map"):
            segmenter.segment(self.entry(path))


@pytest.mark.parametrize(
    ("setting", "value"),
    [("size", 8), ("range_m", -1.0), ("reach", 0.0), ("reach", 0.9), ("turn_deg", 300.0)],
)
def test_settings_out_of_range(setting, value):
    with pytest.raises(ConfigError, match=setting):
        MapGuidedParams(**{setting: value})
