"""How well buildings are told apart, by the command, on views whose labels are counted by hand."""

import json

import cv2
import numpy as np
import pytest

from lodbench.bench.iou_recall import measure_instances
from lodbench.cli import main
from lodbench.datasets.inputs import Input
from lodbench.errors import ConfigError
from lodbench.segmentation.compact import Compact, CompactParams
from lodbench.segmentation.map_instances import MapInstances, MapInstancesParams


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
