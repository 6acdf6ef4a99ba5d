"""Overlap of a mask with the buildings of a map that may be a part of all."""

from __future__ import annotations

import numpy as np
import pytest

from lodbench.segmentation.mapped_overlap import mapped_overlap


def blocks(*corners: tuple[int, int], shape: tuple[int, int] = (300, 400), side: int = 45):
    mask = np.zeros(shape, dtype=bool)
    for row, column in corners:
        mask[row : row + side, column : column + side] = True
    return mask


def test_buildings_far_from_mapped_ones_do_not_count():
    mapped = blocks((30, 30))
    everywhere = blocks((30, 30), (30, 200), (30, 330), (200, 30), (200, 200), (200, 330))
    assert mapped_overlap(mapped, mapped) == 1.0
    assert mapped_overlap(mapped, everywhere) == 1.0
    # IoU would call it a wrong place.
    assert np.count_nonzero(mapped & everywhere) / np.count_nonzero(mapped | everywhere) < 0.2


def test_masks_that_know_nothing_of_the_buildings_have_none():
    mapped, random = blocks((60, 60), (150, 250)), np.random.default_rng(0)
    assert mapped_overlap(mapped, np.ones_like(mapped)) == 0.0
    for share in (0.2, 0.5, 0.8):
        assert mapped_overlap(mapped, random.random(mapped.shape) < share) == pytest.approx(0.0, abs=0.1)
    # Beside it, not on it.
    assert mapped_overlap(mapped, blocks((60, 105), (150, 295))) < 0.0


@pytest.mark.parametrize("shift", [3, 6])
def test_of_masks_that_err_little_it_is_the_iou(shift):
    mapped = blocks((60, 60), (150, 250), side=90)
    mask = np.roll(mapped, shift, axis=1)
    iou = np.count_nonzero(mapped & mask) / np.count_nonzero(mapped | mask)
    assert mapped_overlap(mapped, mask) == pytest.approx(iou, abs=0.02)


def test_a_photo_full_of_mapped_buildings_or_without_any():
    full, none = np.ones((30, 40), dtype=bool), np.zeros((30, 40), dtype=bool)
    assert mapped_overlap(full, full) == 1.0
    assert mapped_overlap(none, full) == 0.0
