"""Recall over the IoU of masks: better masks find more; panoptic quality by hand."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lodbench.bench.iou_recall import InstanceMatches, match_instances, measure_iou_recall
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.synthesis.views_dataset import ViewsParams
from tests.town import write_dataset


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    _, city = write_dataset(tmp_path_factory.mktemp("town"), count=1)
    views = ViewsParams(str(city), num_views=3)
    return measure_iou_recall(views, [LodLocV2()], ious=(0.35, 1.0), threads=1)


def test_better_masks_find_more(report):
    worse, better = report.data.query("tilt == 'truth'").to_dict("records")
    assert better["recall"] == 100.0
    assert worse["recall"] < better["recall"]
    assert worse["low"] <= worse["recall"] <= worse["high"]


def test_figures_and_text_name_every_iou(report):
    names = [figure.figure for figure in report.figures]
    assert "recall_2m-2deg_lodlocv2_iou_0.35_tilt_truth" in names
    assert len(names) == 4
    assert "100.0" in report.text


def test_the_curve_is_a_picture(report, tmp_path):
    report.write_pictures(tmp_path / "pictures")
    assert cv2.imread(str(tmp_path / "pictures" / "iou_recall.png")).shape[2] == 3


LABELS = arrays(np.uint16, (12, 9), elements=st.integers(0, 4))


def test_two_buildings_taken_for_one_are_one_pair_or_none():
    true = np.zeros((10, 20), np.uint16)
    true[:, :12], true[:, 12:] = 1, 2
    matches = match_instances(np.ones_like(true), true, 1)
    # The larger covers 120 of 200 pixels: it is matched, the other is missed.
    assert matches == InstanceMatches(1, 0.6, 1, 2)
    assert matches.recognition == pytest.approx(2 / 3)
    assert matches.segmentation == pytest.approx(0.6)
    assert matches.panoptic == pytest.approx(0.4)
    true[:, :10], true[:, 10:] = 1, 2
    assert match_instances(np.ones_like(true), true, 1).matched == 0


def test_small_ones_do_not_count_on_either_side():
    true = np.zeros((10, 10), np.uint16)
    true[:2, :2], true[5:, 5:] = 1, 2
    found = np.where(true == 2, 7, 0)
    found[0, 9] = 3
    assert match_instances(found, true, 5) == InstanceMatches(1, 1.0, 1, 1)
    assert match_instances(found, true, 1) == InstanceMatches(1, 1.0, 2, 2)


@given(LABELS)
def test_labels_agree_with_themselves_by_any_name(labels):
    renamed = np.where(labels > 0, 9 - labels, 0)
    matches = match_instances(renamed, labels, 1)
    count = len(np.unique(labels[labels > 0]))
    assert matches == InstanceMatches(count, float(count), count, count)


@given(LABELS, LABELS)
def test_it_is_symmetric_and_sums(one, other):
    ahead, back = match_instances(one, other, 1), match_instances(other, one, 1)
    assert (ahead.matched, ahead.iou_sum) == (back.matched, pytest.approx(back.iou_sum))
    both = ahead + back
    assert both.predicted == both.true
    assert ahead.matched <= min(ahead.predicted, ahead.true)
