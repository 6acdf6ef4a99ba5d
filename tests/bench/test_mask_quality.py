"""IoU of masks and single buildings, counted by hand: over rendered views, real photos, views with labels."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pandas as pd
import pytest

from lodbench.bench.iou_recall import measure_instances
from lodbench.bench.mask_quality import MaskQualityOptions, measure_masks, summary_of
from lodbench.bench.photo_masks import measure_photo_masks
from lodbench.cli import main
from lodbench.cli.bench import BENCHES
from lodbench.datasets.inputs import Input
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation.pose_errors import bootstrap_ratio
from lodbench.segmentation.map_guided import MapInstances, MapInstancesParams
from lodbench.segmentation.packaged import Compact, CompactParams
from lodbench.segmentation.photo_segmenter import PhotoSegmenter

# Left edge of the building in each view, 20 wide; the last view shows too little of one.
LEFT = {"00": 4, "01": 8, "02": 12}


class Reddish(PhotoSegmenter):
    """Finds what is red."""

    weights_digest = "f" * 64

    def logits(self, photo):
        return (photo[..., 0].astype(np.float32) - 128) / 8


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """Three views 40 x 30 and one without buildings; a tree hides the right quarter of each building."""
    root = tmp_path_factory.mktemp("sets")
    for folder in ("data/train/images", "data/train/masks", "visible/train/masks"):
        (root / folder).mkdir(parents=True)
    for name, left in [*LEFT.items(), ("03", None)]:
        photo, mask = np.full((30, 40, 3), 60, np.uint8), np.zeros((30, 40), np.uint8)
        visible = mask.copy()
        if left is not None:
            mask[5:25, left : left + 20] = 255
            visible[5:25, left : left + 15] = 255
            photo[visible > 0] = (0, 0, 250)
            photo[0:5, 0:10] = (0, 0, 250)  # a red car: 50 pixels too many
        cv2.imwrite(str(root / "data/train/images" / f"{name}.png"), photo)
        cv2.imwrite(str(root / "data/train/masks" / f"{name}.png"), mask)
        cv2.imwrite(str(root / "visible/train/masks" / f"{name}.png"), visible)
    return root


@pytest.fixture(scope="module")
def report(sets):
    options = MaskQualityOptions(sets / "data", sets / "visible")
    return measure_masks(Reddish(CompactParams(name="reddish")), options)


def test_overlaps_are_those_counted_by_hand(report):
    assert report.data["key"].tolist() == ["train/00", "train/01", "train/02"]
    for kind, overlap in {"mask": (300, 450), "ceiling": (300, 400), "visible": (300, 350)}.items():
        assert (report.data[[f"{kind} shared", f"{kind} union"]] == list(overlap)).all(axis=None)
    figures = {figure.figure: figure.value for figure in report.figures}
    assert figures["mask_iou_mean"] == figures["mask_iou_pooled"] == pytest.approx(300 / 450)
    assert figures["mask_iou_ceiling_mean"] == pytest.approx(0.75)
    assert figures["visible_iou_pooled"] == pytest.approx(300 / 350)
    assert figures["views"] == 3
    assert figures["cpu_seconds_per_photo"] > 0


def test_mean_and_pooled_weigh_views_differently():
    views = pd.DataFrame({"mask shared": [10, 900], "mask union": [20, 1000]})
    found = summary_of(views, "mask")
    assert found.mean == pytest.approx(0.7)
    assert found.pooled == pytest.approx(910 / 1020)
    assert found.mean_interval[0] <= found.mean <= found.mean_interval[1]
    assert found.pooled_interval == pytest.approx((0.5, 0.9))


def test_a_ratio_is_resampled_in_pairs():
    generator = np.random.default_rng(0)
    wholes = generator.uniform(1, 1000, 50)
    # Were parts and wholes drawn apart, the ratio would vary by far more than this.
    low, high = bootstrap_ratio(0.8 * wholes, wholes)
    assert (low, high) == pytest.approx((0.8, 0.8))
    parts = wholes * generator.uniform(0.5, 1, 50)
    low, high = bootstrap_ratio(parts, wholes)
    order = generator.permutation(50)
    assert bootstrap_ratio(parts[order], wholes[order]) == pytest.approx((low, high))
    drawn = generator.integers(50, size=(4000, 50))
    ends = np.percentile(parts[drawn].sum(axis=1) / wholes[drawn].sum(axis=1), (2.5, 97.5))
    assert (low, high) == pytest.approx(tuple(ends), abs=0.01)


def test_the_text_says_what_was_measured(report):
    told = report.text
    assert "3 of the 4 views of data, those with 5 % buildings or more, 40 x 30" in told
    assert "0.667" in told
    assert "0.750" in told
    assert "weights ffffffffffff" in told


def test_the_sheet_tints_what_is_wrong(report, tmp_path):
    report.write_pictures(tmp_path / "new")
    sheet = cv2.imread(str(tmp_path / "new" / "masks.png"))
    for bgr in ((30, 120, 255), (255, 60, 190)):
        tint = 0.65 * np.array(bgr)
        assert (abs(sheet - tint).max(axis=2) < 90).mean() > 0.01


def test_without_a_visible_set_there_is_no_ceiling(sets):
    found = measure_masks(Reddish(CompactParams()), MaskQualityOptions(sets / "data"))
    assert [figure.figure for figure in found.figures][:3] == ["mask_iou_mean", "mask_iou_pooled", "views"]


def test_sets_that_do_not_belong_together_are_refused(sets, tmp_path):
    other = tmp_path / "other" / "train" / "masks"
    other.mkdir(parents=True)
    segmenter = Reddish(CompactParams())
    options = MaskQualityOptions(sets / "data", tmp_path / "other")
    with pytest.raises(DatasetError, match="has no mask of train/00") as told:
        measure_masks(segmenter, options)
    assert "occluders_in_mask=true" in told.value.hint
    for name in LEFT:
        cv2.imwrite(str(other / f"{name}.png"), np.full((30, 40), 255, np.uint8))
    with pytest.raises(DatasetError, match="is not the visible part of"):
        measure_masks(segmenter, options)
    with pytest.raises(DatasetError, match="None of the 4 views"):
        measure_masks(segmenter, MaskQualityOptions(sets / "data", least_share=0.9))


def test_the_command_measures_the_shipped_network(sets, tmp_path, capsys):
    words = ["bench", "segmentation", "--data", str(sets / "data"), "--visible", str(sets / "visible")]
    assert main([*words, "--json", "--pictures", str(tmp_path)]) == 0
    figures = {row["figure"]: row for row in map(json.loads, capsys.readouterr().out.splitlines())}
    assert figures["mask_iou_ceiling_mean"]["value"] == pytest.approx(0.75)
    assert (tmp_path / "masks.png").is_file()


def test_both_sets_of_a_town_show_the_same_views(tmp_path, monkeypatch):
    from lodbench.bench import mask_quality

    made = []
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path))
    monkeypatch.setattr(mask_quality, "generate_training_data", made.append)
    monkeypatch.setattr(mask_quality, "demo_folder", lambda params: tmp_path / params.look)
    data, visible = mask_quality.town_sets("test", 80)
    photos, cut = made
    assert (photos.out, cut.out) == (str(data), str(visible))
    assert replace(cut, out=photos.out, occluders_in_mask=False, images=True) == photos
    assert (photos.limit, photos.size, photos.min_buildings) == (80, (512, 384), 0.05)
    assert photos.city.startswith(str(tmp_path / "test"))
    assert mask_quality.town_sets("test", 80).data == data
    assert mask_quality.town_sets("test", 81).data != data


def place(root, name, photos):
    """Writes photos of (true box, red box), columns from and to of 30 x 40 pixels."""
    (root / name / "photos").mkdir(parents=True)
    (root / name / "masks").mkdir()
    for number, (truth, red) in enumerate(photos):
        mask, photo = np.zeros((30, 40), np.uint8), np.full((30, 40, 3), 60, np.uint8)
        mask[:, slice(*truth)] = 255
        photo[:, slice(*red)] = (0, 0, 250)
        cv2.imwrite(str(root / name / "photos" / f"{number}.png"), photo)
        cv2.imwrite(str(root / name / "masks" / f"{number}.png"), mask)


@pytest.fixture
def folder(tmp_path):
    place(tmp_path, "town", [((0, 20), (0, 20)), ((0, 20), (0, 10)), ((0, 20), (10, 30))])
    place(tmp_path, "village", [((10, 20), (0, 40))])
    place(tmp_path, "meadow", [((0, 0), (0, 4)), ((0, 0), (0, 0))])
    return tmp_path


def test_ious_and_shares_are_those_counted_by_hand(folder):
    report = measure_photo_masks(Reddish(CompactParams(name="reddish")), folder)
    figures = {f.figure: f.value for f in report.figures()}
    assert report.by_place()["town"] == pytest.approx([1.0, 0.5, 1 / 3])
    assert figures["IoU of village"] == 0.25
    assert figures["IoU, mean over photos"] == pytest.approx((1 + 0.5 + 1 / 3 + 0.25) / 4)
    assert figures["IoU, mean over places"] == pytest.approx(((1 + 0.5 + 1 / 3) / 3 + 0.25) / 2)
    assert figures["share found in photos without buildings"] == pytest.approx(0.05)
    assert "meadow" in report.to_text()
    report.write_pictures(folder / "out")
    picture = cv2.imread(str(folder / "out" / "town" / "2.png"))
    # Right of the true box what was found is orange, in it what was missed violet.
    assert picture[15, 27, 2] > picture[15, 27, 0]
    assert picture[15, 5, 0] > picture[15, 5, 1]
    sheet = cv2.imread(str(folder / "out" / "masks.png"))
    # A strip above, and two rows of four.
    assert sheet.shape == (34 + 2 * (448 * 3 // 4 + 24 + 4), 4 * (448 + 4), 3)


def test_the_folder_of_all_photos_will_do_as_well(tmp_path):
    place(tmp_path / "all" / "labelled", "town", [((0, 20), (0, 20))])
    report = measure_photo_masks(Reddish(CompactParams(name="reddish")), tmp_path / "all")
    assert report.by_place() == {"town": [1.0]}


def test_what_is_refused(folder, capsys):
    (folder / "town" / "masks" / "1.png").unlink()
    for wrong, words in (
        ([str(folder)], "has no mask"),
        ([str(folder / "town")], f"name the folder that holds it, {folder}."),
        ([str(folder), "--views", "3"], "by themselves"),
        ([str(folder), "--instances"], "by themselves"),
        ([str(folder), "--segmenter", "masks"], "looks at no photo alone"),
    ):
        assert main(["bench", "segmentation", "--photos", *wrong]) == 2
        assert words in capsys.readouterr().err


def test_a_single_photo_has_no_interval(folder):
    text = measure_photo_masks(Reddish(CompactParams(name="reddish")), folder).to_text()
    assert ["village", "1", "0.250", "-"] in [line.split() for line in text.splitlines()]


def test_pictures_that_cannot_be_kept_are_told_before_the_work(folder, capsys, monkeypatch):
    asked = []
    fake = BENCHES["segmentation"]._replace(measure=lambda options, steps: asked.append(options))
    monkeypatch.setitem(BENCHES, "segmentation", fake)
    (folder / "file").write_text("")
    words = ["bench", "segmentation", "--photos", str(folder), "--pictures", str(folder / "file")]
    assert main(words) == 2
    assert "file: File exists" in capsys.readouterr().err
    assert asked == []


@pytest.mark.slow
def test_the_command_on_real_photos(shared_data, capsys, tmp_path):
    photos = shared_data / "real_photos" / "labelled"
    if not photos.is_dir():
        pytest.skip("no real photos here")
    assert main(["bench", "segmentation", "--photos", str(photos), "--pictures", str(tmp_path)]) == 0
    assert "thermal" in capsys.readouterr().out
    assert len(list(tmp_path.glob("*/*.png"))) == len(list(photos.glob("*/photos/*")))


class Halves:
    """Takes the whole photo for building, and its halves for two."""

    name = "halves"
    requires = frozenset({Input.IMAGE})

    def segment(self, entry):
        return np.ones((20, 40), np.float32)

    def segment_instances(self, entry):
        left = np.zeros((20, 40), np.bool_)
        left[:, :20] = True
        return np.stack([left, ~left])


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """One view whose right half is one building, its left half two."""
    root = tmp_path_factory.mktemp("set")
    for kind in ("images", "labels"):
        (root / "train" / kind).mkdir(parents=True)
    labels = np.full((40, 80), 5, np.uint16)
    labels[:10, :40], labels[10:, :40] = 2, 3
    cv2.imwrite(str(root / "train" / "images" / "0.png"), np.full((40, 80, 3), 90, np.uint8))
    cv2.imwrite(str(root / "train" / "labels" / "0.png"), labels)
    return root


def test_quality_is_that_counted_by_hand(labelled):
    report = measure_instances(Halves(), labelled)
    figures = {figure.figure: figure.value for figure in report.figures}
    # The right half exactly, and three quarters of the left: two pairs of 2 found and 3 there.
    assert figures["buildings_rq"] == pytest.approx(2 * 2 / 5)
    assert figures["buildings_sq"] == pytest.approx((1.0 + 0.75) / 2)
    assert figures["buildings_pq"] == pytest.approx(2 * 1.75 / 5)
    # The mask is one part, half of which is the largest building: an IoU of one half is no pair.
    assert figures["parts_of_its_mask_rq"] == 0


def test_what_tells_no_buildings_apart_is_refused(labelled, capsys):
    # The second tells them apart, but by a map.
    for segmenter in (Compact(CompactParams()), MapInstances(MapInstancesParams())):
        with pytest.raises(ConfigError, match="does not separate buildings") as told:
            measure_instances(segmenter, labelled)
        assert "--segmenter compact_instances" in told.value.hint
    assert main(["bench", "segmentation", "--instances"]) == 2
    assert "--data SET" in capsys.readouterr().err


def test_the_command_prints_it(labelled, capsys):
    assert main(["bench", "segmentation", "--data", str(labelled), "--instances", "--json"]) == 0
    names = [json.loads(line)["figure"] for line in capsys.readouterr().out.splitlines()]
    assert "buildings_pq" in names
