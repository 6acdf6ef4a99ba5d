"""IoU of a segmenter's masks: counted by hand, beside the ceiling; sets that do not belong together."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pandas as pd
import pytest

from lodbench.bench.mask_quality import MaskQualityOptions, measure_masks, summary_of
from lodbench.cli import main
from lodbench.errors import DatasetError
from lodbench.evaluation.statistics import bootstrap_ratio
from lodbench.segmentation.compact import CompactParams
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
