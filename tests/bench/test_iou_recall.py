"""Recall over the IoU of masks: better masks find more, and the curve is drawn."""

import cv2
import pytest

from lodbench.bench.iou_recall import measure_iou_recall
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
