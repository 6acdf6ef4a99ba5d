"""Networks of the package without torch: whose weights they are, single buildings, a photo's own colours."""

import subprocess
import sys

import cv2
import numpy as np
import pytest
from scipy.special import expit

from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, QueryFault
from lodbench.segmentation import InstanceSegmenter
from lodbench.segmentation.packaged import (
    Compact,
    CompactInstances,
    CompactInstancesParams,
    CompactParams,
    EfficientUnet,
    EfficientUnetParams,
    adapted,
    interiors,
    separated,
)
from lodbench.storage import file_digest

SHIPPED = {"compact": Compact(CompactParams()), "efficient_unet": EfficientUnet(EfficientUnetParams())}


@pytest.mark.parametrize(("name", "most_bytes"), [("compact", 8_000_000), ("efficient_unet", 20_000_000)])
def test_the_weights_are_those_of_their_record(name, most_bytes):
    network = SHIPPED[name]
    path = network.packaged_weights()
    assert network.packaged_training()["weights"][path.name] == file_digest(path)
    assert path.stat().st_size <= most_bytes


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["Compact", "EfficientUnet"])
def test_they_answer_without_torch_and_say_where_they_come_from(kind):
    code = f"""
import sys
import numpy as np
from lodbench.segmentation.packaged import {kind}, {kind}Params
network = {kind}({kind}Params())
found = network.probability(np.full((90, 120, 3), 128, np.uint8))
assert found.shape == (384, 512) and found.dtype == np.float32
assert 0 <= found.min() <= found.max() <= 1
assert "torch" not in sys.modules
print(network.notes()[0])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "domain: synthetic" in done.stdout


HEIGHT, WIDTH = 225, 300
GROUND, ROOF = (70, 120, 60), (150, 150, 165)


def photo_of(truth, generator, colours=(GROUND, ROOF), scale=1):
    """A photo of a mask in two colours, with noise, ``scale`` times as large."""
    picture = np.where(truth[..., None], colours[1], colours[0]) + generator.normal(0, 8, (*truth.shape, 3))
    return np.clip(picture, 0, 255).astype(np.uint8).repeat(scale, 0).repeat(scale, 1)


def town():
    """A mask of two halls of the same roof, and logits that are sure of one and doubt the other."""
    truth = np.zeros((HEIGHT, WIDTH), bool)
    truth[40:110, 30:130] = truth[120:200, 170:270] = True
    logits = np.where(truth, 3.0, -3.0).astype(np.float32)
    logits[120:200, 170:270] = -0.8
    return truth, logits


def iou(one, other):
    return (one & other).sum() / (one | other).sum()


def test_a_roof_that_the_network_doubts_is_found_by_the_colour_of_one_it_is_sure_of():
    truth, logits = town()
    photo = photo_of(truth, np.random.default_rng(0), scale=2)
    assert iou(logits > 0, truth) < 0.5
    found = adapted(logits, photo, 0.6)
    assert found.shape == logits.shape
    assert found.dtype == np.float32
    assert iou(found > 0, truth) > 0.97


def test_even_pictures_and_no_weight_change_no_decision():
    truth, logits = town()
    grey = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    np.testing.assert_array_equal(adapted(logits, photo_of(truth, np.random.default_rng(0)), 0.0), logits)
    # A classifier that sees no difference says the share of each class at most: here far from a doubt.
    np.testing.assert_array_equal(adapted(logits, grey, 0.6) > 0, logits > 0)


def test_no_building_is_taught_by_a_few_pixels():
    logits = np.full((HEIGHT, WIDTH), -4.0, np.float32)
    logits[100:105, 100:105] = 4.0
    photo = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    np.testing.assert_array_equal(adapted(logits, photo, 0.6), logits)


def test_a_mirrored_photo_has_the_mirrored_answer():
    truth, logits = town()
    photo = photo_of(truth, np.random.default_rng(2))
    mirrored = adapted(np.ascontiguousarray(logits[:, ::-1]), np.ascontiguousarray(photo[:, ::-1]), 0.6)
    np.testing.assert_allclose(expit(mirrored[:, ::-1]), expit(adapted(logits, photo, 0.6)), atol=1e-3)


def test_any_shape_of_photo():
    generator = np.random.default_rng(3)
    for shape in ((1, 1), (1, 400), (3, 700), (640, 5)):
        photo = generator.integers(0, 256, (*shape, 3), dtype=np.uint8)
        logits = generator.normal(0, 3, shape).astype(np.float32)
        found = adapted(logits, photo, 0.6)
        assert found.shape == shape
        assert np.isfinite(found).all()


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
    labels = separated(mask, inside)
    assert ((labels > 0) == mask).all()
    left, right, alone = (
        np.unique(labels[:, part]) for part in (slice(10, 28), slice(33, 50), slice(60, 75))
    )
    assert [len(part) for part in (left, right, alone)] == [2, 2, 2]
    assert len({int(part[-1]) for part in (left, right, alone)}) == 3


def test_nothing_is_separated_where_nothing_is():
    nothing = np.zeros((8, 8), bool)
    assert not separated(nothing, nothing).any()
    assert not separated(nothing, ~nothing).any()


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
