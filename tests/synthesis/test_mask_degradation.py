"""Masks and instances as wrong as a network's."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lodbench.errors import LodbenchError
from lodbench.storage import random_stream
from lodbench.synthesis.mask_degradation import (
    IOU_TOLERANCE,
    degrade_mask,
    degraded_instances,
    distances_to_buildings,
    mask_iou,
    smooth_noise,
)


def town_mask(seed: int = 0, size: tuple[int, int] = (448, 602), count: int = 25) -> np.ndarray:
    """Returns rotated rectangles, as roofs and facades look from a drone."""
    generator = np.random.default_rng(seed)
    image = np.zeros(size, np.uint8)
    for _ in range(count):
        center = generator.uniform(0, size[1]), generator.uniform(0, size[0])
        box = cv2.boxPoints((center, tuple(generator.uniform(25, 110, 2)), generator.uniform(0, 180)))
        cv2.fillConvexPoly(image, box.astype(np.int32), 1)
    return image.astype(bool)


@pytest.mark.parametrize("target", [0.999, 0.97, 0.88, 0.80, 0.55, 0.31, 0.05])
@pytest.mark.parametrize("seed", range(3))
def test_hits_the_target(target, seed):
    mask = town_mask(seed)
    rough, achieved = degrade_mask(mask, target, random_stream(seed, "rough"))
    assert rough.dtype == np.bool_
    assert rough.shape == mask.shape
    assert achieved == mask_iou(rough, mask)
    assert abs(achieved - target) <= IOU_TOLERANCE


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**31),
    st.floats(0.31, 0.999),
    st.tuples(st.integers(60, 200), st.integers(60, 250)),
    st.integers(3, 30),
    st.booleans(),
)
def test_hits_the_target_on_any_image(seed, target, size, count, trees):
    mask = town_mask(seed, size, count)
    if mask.sum() < 2000:
        return
    _, achieved = degrade_mask(mask, target, random_stream(seed, "any"), trees=trees)
    assert abs(achieved - target) <= IOU_TOLERANCE


def test_target_one_is_the_mask_itself():
    mask = town_mask()
    rough, achieved = degrade_mask(mask, 1.0, random_stream(0))
    np.testing.assert_array_equal(rough, mask)
    assert rough is not mask
    assert achieved == 1.0


def test_same_stream_same_mask():
    mask = town_mask()
    first, second = (degrade_mask(mask, 0.88, random_stream(5, "q"))[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    other, _ = degrade_mask(mask, 0.88, random_stream(6, "q"))
    assert (first != other).any()


def test_the_mask_given_is_left_alone():
    mask = town_mask()
    before = mask.copy()
    degrade_mask(mask, 0.6, random_stream(0))
    np.testing.assert_array_equal(mask, before)


@pytest.mark.parametrize("target", [0.88, 0.80, 0.5])
def test_errors_are_areas_not_pixels(target):
    mask = town_mask(1)
    rough, _ = degrade_mask(mask, target, random_stream(1, "areas"))
    wrong = (rough ^ mask).view(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(wrong, connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    assert areas[areas >= 20].sum() > 0.9 * areas.sum()
    # A wrong pixel's neighbour is wrong far more often than by chance (which is about 1 - target).
    beside = (wrong[:, 1:] & wrong[:, :-1]).sum() / wrong[:, 1:].sum()
    assert beside > 0.75


def test_both_kinds_of_error_occur():
    lost, gained = 0, 0
    for seed in range(6):
        mask = town_mask(seed)
        rough, _ = degrade_mask(mask, 0.85, random_stream(seed))
        lost, gained = lost + (mask & ~rough).sum(), gained + (rough & ~mask).sum()
    assert min(lost, gained) > 0.2 * (lost + gained)


def test_trees_stand_before_the_lower_outlines():
    mask = np.zeros((300, 400), bool)
    mask[80:220, 60:340] = True
    # A high target leaves hardly more than the first crowns.
    lost = np.zeros(mask.shape)
    for seed in range(20):
        with_trees, _ = degrade_mask(mask, 0.9, random_stream(seed), trees=True)
        without, _ = degrade_mask(mask, 0.9, random_stream(seed), trees=False)
        lost += (mask & ~with_trees).astype(float) - (mask & ~without)
    assert lost[180:220].sum() > 5 * max(lost[80:120].sum(), 1)


def test_an_empty_mask_stays_empty():
    rough, achieved = degrade_mask(np.zeros((40, 50), bool), 0.8, random_stream(0))
    assert not rough.any()
    assert achieved == 0.0


@pytest.mark.parametrize("target", [0.9, 0.4])
def test_a_mask_without_background_loses_areas(target):
    rough, achieved = degrade_mask(np.ones((200, 300), bool), target, random_stream(0))
    assert abs(achieved - target) <= IOU_TOLERANCE
    assert not rough.all()


@pytest.mark.parametrize(("count", "target"), [(1, 0.5), (9, 0.8)])
def test_tiny_masks_come_as_near_as_pixels_allow(count, target):
    mask = np.zeros((60, 80), bool)
    mask.reshape(-1)[2000 : 2000 + count] = True
    _, achieved = degrade_mask(mask, target, random_stream(0))
    assert abs(achieved - target) <= 1.0 / count


@pytest.mark.parametrize("target", [0.0, -1.0, 1.01, float("nan")])
def test_targets_out_of_range_are_refused(target):
    with pytest.raises(LodbenchError, match="target IoU"):
        degrade_mask(town_mask(), target, random_stream(0))


def test_a_scale_of_zero_is_refused():
    with pytest.raises(LodbenchError, match="scale"):
        degrade_mask(town_mask(), 0.8, random_stream(0), pixels_per_m=0.0)


@pytest.mark.parametrize("bad", [np.zeros((3, 4)), np.zeros((2, 3, 4), bool)])
def test_what_is_no_mask_is_refused(bad):
    with pytest.raises(LodbenchError, match="bool"):
        degrade_mask(bad, 0.8, random_stream(0))


def test_smooth_noise_has_unit_variance_and_the_wavelength():
    fields = [smooth_noise((200, 300), 24.0, random_stream(k, "noise")) for k in range(30)]
    assert np.std(fields) == pytest.approx(1.0, abs=0.05)
    field = fields[0]
    near = np.corrcoef(field[:, :-2].ravel(), field[:, 2:].ravel())[0, 1]
    far = np.corrcoef(field[:, :-40].ravel(), field[:, 40:].ravel())[0, 1]
    assert near > 0.95
    assert abs(far) < 0.3


def test_signed_distance_counts_from_the_outline():
    mask = np.zeros((20, 30), bool)
    mask[5:15, 10:20] = True
    mask[5:15, 25:] = True
    distance, labels = distances_to_buildings(mask)
    assert distance[10, 10] == pytest.approx(0.5)
    assert distance[10, 9] == pytest.approx(-0.5)
    assert distance[10, 7] == pytest.approx(-2.5)
    assert labels[10, 12] == labels[10, 9] != labels[10, 27]


SHAPE = (120, 200)


def blocks() -> np.ndarray:
    """Five buildings side by side, 30 x 60 pixels each, with numbers that are no row of small ones."""
    buildings = np.full(SHAPE, -1, np.int32)
    for k in range(5):
        buildings[30:90, 20 + 30 * k : 50 + 30 * k] = 7 * k + 3
    return buildings


def degraded(seed: int = 0, mask: np.ndarray | None = None, **shares: float) -> np.ndarray:
    buildings = blocks()
    return degraded_instances(
        buildings, buildings >= 0 if mask is None else mask, np.random.default_rng(seed), **shares
    )


def best_iou(labels: np.ndarray, truth: np.ndarray) -> float:
    return max(
        np.count_nonzero((labels == k) & truth) / np.count_nonzero((labels == k) | truth)
        for k in np.unique(labels[truth])
    )


@pytest.mark.parametrize(("merged", "split", "count"), [(0.0, 0.0, 5), (0.0, 1.0, 10)])
def test_without_merges_there_are_as_many_as_in_truth_and_splits_double_them(merged, split, count):
    labels = degraded(merged=merged, split=split)
    assert np.unique(labels).tolist() == list(range(count + 1))
    assert ((labels > 0) == (blocks() >= 0)).all()


def test_merges_join_neighbours_only():
    labels = degraded(merged=1.0, split=0.0)
    groups = [np.unique(blocks()[labels == k]) for k in range(1, labels.max() + 1)]
    assert 1 <= len(groups) <= 2
    for group in groups:
        assert (np.diff(group) == 7).all()


def test_borders_wobble_by_a_metre_or_so():
    ious = [best_iou(degraded(seed, merged=0, split=0), blocks() == 17) for seed in range(8)]
    assert 0.75 < np.mean(ious) < 0.98


def test_parts_of_the_mask_without_a_building_are_ones_of_their_own():
    mask = blocks() >= 0
    mask[100:110, 5:15] = True
    mask[20:30, 20:50] = True
    labels = degraded(mask=mask, merged=0, split=0)
    assert ((labels > 0) == mask).all()
    (patch,) = np.unique(labels[100:110, 5:15])
    assert not (labels[20:95] == patch).any()
    # What grew onto a building is the building's.
    assert np.unique(labels[20:28, 25:40]).tolist() == np.unique(labels[40:80, 25:40]).tolist()


def test_nothing_is_nothing_and_the_same_draws_are_the_same():
    empty = np.zeros(SHAPE, bool)
    assert not degraded(mask=empty).any()
    nowhere = np.full(SHAPE, -1, np.int32)
    assert not degraded_instances(nowhere, empty, np.random.default_rng(0)).any()
    assert degraded_instances(nowhere, blocks() >= 0, np.random.default_rng(0)).max() == 1
    np.testing.assert_array_equal(degraded(3), degraded(3))
