"""Recall over the IoU of masks: better masks find more, and the curve is drawn."""

import cv2
import pytest

from lodbench.bench.iou_recall import IouRecallOptions, measure_iou_recall
from tests.town import write_dataset


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    _, city = write_dataset(tmp_path_factory.mktemp("town"), count=1)
    return measure_iou_recall(city, IouRecallOptions(num_views=3, ious=(0.35, 1.0), threads=1))


def test_better_masks_find_more(report):
    worse, better = report.recall("truth")
    assert better[0] == 100.0
    assert worse[0] < better[0]
    assert worse[1] <= worse[0] <= worse[2]


def test_figures_and_text_name_every_iou(report):
    names = [figure.figure for figure in report.figures()]
    assert "recall_2m-2deg_lodlocv2_iou_0.35_tilt_truth" in names
    assert len(names) == 4
    assert "100.0" in report.to_text()


def test_the_curve_is_a_picture(report, tmp_path):
    assert cv2.imread(str(report.write_picture(tmp_path / "pictures"))).shape[2] == 3
