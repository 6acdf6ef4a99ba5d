"""Instances as wrong as a network's: they fill the mask, and merges, splits and borders are as asked."""

from __future__ import annotations

import numpy as np
import pytest

from lodbench.synthesis.instance_degradation import degraded_instances

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
