"""Buildings told apart by the photo alone: what the network learns, and what becomes of its answer."""

import cv2
import numpy as np
import pytest

from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, QueryFault
from lodbench.segmentation import InstanceSegmenter
from lodbench.segmentation.compact import (
    CompactInstances,
    CompactInstancesParams,
    interiors,
    told_apart,
)


def test_an_interior_is_two_pixels_from_another_building_and_from_the_ground():
    labels = np.zeros((20, 30), np.uint16)
    labels[5:15, 5:15], labels[5:15, 15:25] = 3, 8
    found = interiors(labels)
    wanted = np.zeros_like(found)
    wanted[7:13, 7:13] = wanted[7:13, 17:23] = True
    assert (found == wanted).all()
    # A picture's edge is no border.
    assert interiors(np.full((6, 6), 2, np.uint16)).all()


def test_each_inside_is_a_building_that_grows_over_the_mask():
    mask = np.zeros((40, 80), bool)
    mask[10:30, 10:50] = mask[10:30, 60:75] = True
    inside = np.zeros_like(mask)
    inside[14:26, 14:27] = inside[14:26, 33:46] = True
    inside[12:14, 62:65] = True  # too small for a building's inside
    inside[0:6, 0:20] = True  # not in the mask
    labels = told_apart(mask, inside)
    assert ((labels > 0) == mask).all()
    left, right, alone = (
        np.unique(labels[:, part]) for part in (slice(10, 28), slice(33, 50), slice(60, 75))
    )
    assert [len(part) for part in (left, right, alone)] == [2, 2, 2]
    assert len({int(part[-1]) for part in (left, right, alone)}) == 3


def test_nothing_is_told_apart_where_nothing_is():
    nothing = np.zeros((8, 8), bool)
    assert not told_apart(nothing, nothing).any()
    assert not told_apart(nothing, ~nothing).any()


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """A photo from above of three flat roofs that touch, on grass; and an entry of it."""
    photo = np.full((192, 256, 3), (70, 120, 80), np.uint8)
    for left, colour in ((40, (60, 70, 170)), (95, (150, 150, 155)), (150, (90, 60, 60))):
        photo[60:130, left : left + 55] = colour
    noise = np.random.default_rng(3).normal(0, 6, photo.shape)
    path = tmp_path_factory.mktemp("street") / "photo.png"
    cv2.imwrite(str(path), np.clip(photo + noise, 0, 255).astype(np.uint8))
    return Entry("photo.png", "", None, None, path, None)


def test_the_package_s_network_fills_its_mask_with_buildings(street):
    segmenter = CompactInstances(CompactInstancesParams(size=256))
    assert isinstance(segmenter, InstanceSegmenter)
    mask = segmenter.segment(street) >= 0.5
    masks = segmenter.segment_instances(street)
    assert masks.dtype == np.bool_
    assert masks.shape[1:] == mask.shape == (192, 256)
    assert (masks.sum(axis=0) == mask).all()
    again = CompactInstances(CompactInstancesParams(size=256)).segment_instances(street)
    assert (again == masks).all()
    assert segmenter.fingerprint((street,)) != CompactInstances(
        CompactInstancesParams(size=256, interior=0.6)
    ).fingerprint((street,))


def test_wrong_settings_weights_and_no_photo_are_one_line(tmp_path):
    with pytest.raises(ConfigError, match=r"segmenter\.interior=1"):
        CompactInstancesParams(interior=1.0)
    with pytest.raises(ConfigError, match=r"segmenter\.size=8"):
        CompactInstancesParams(size=8)
    junk = tmp_path / "junk.onnx"
    junk.write_bytes(b"junk")
    photo = Entry("a.png", "", None, None, None, None)
    with pytest.raises(ConfigError, match=r"junk\.onnx"):
        CompactInstances(CompactInstancesParams(weights=str(junk))).segment(photo)
    with pytest.raises(QueryFault, match="no photo"):
        CompactInstances(CompactInstancesParams()).segment_instances(photo)
