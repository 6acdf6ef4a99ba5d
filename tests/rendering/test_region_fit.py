"""The region fit against plain numpy, pixel by pixel; what makes it large and small."""

import math

import numpy as np
import pytest
from hostile_scenes import box, scene_of
from hypothesis import given
from hypothesis import strategies as st
from mask_blobs import blobs, packed

from lodbench.errors import RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotations_at_yaws
from lodbench.rendering import ContourFit, RegionFit, appearance_bins, edge_bins, make_renderer

SIZES = [(1, 1), (1, 9), (63, 5), (64, 7), (65, 1), (127, 30), (150, 41)]


def sequential_code_length(values, num_bins):
    """Returns the nats of coding values one by one, each by what came before (Krichevsky, Trofimov)."""
    counts, nats = np.full(num_bins, 0.5), 0.0
    for value in values:
        nats -= math.log(counts[value] / counts.sum())
        counts[value] += 1
    return nats


def plain_fit(mask, bins, num_bins):
    whole, inside, outside = (
        sequential_code_length(v, num_bins) for v in (bins.ravel(), bins[mask], bins[~mask])
    )
    return max(0.0, whole - inside - outside) / bins.size


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_it_is_what_coding_pixel_by_pixel_saves(width, height):
    rng = np.random.default_rng(1)
    masks = blobs(rng, width, height, 6)
    bins = rng.integers(0, 7, (height, width)) // (1 + masks[3])
    expected = [plain_fit(mask, bins, 7) for mask in masks]
    np.testing.assert_allclose(RegionFit(bins, 7)(packed(masks)), expected, atol=1e-10)


@given(st.integers(0, 2**32), st.permutations(range(9)))
def test_order_and_company_of_silhouettes_change_no_bit(seed, order):
    rng = np.random.default_rng(seed)
    masks = blobs(rng, 70, 20, 9)
    fit = RegionFit(rng.integers(0, 12, (20, 70)), 12)
    whole = fit(packed(masks))
    np.testing.assert_array_equal(fit(packed(masks[order])), whole[order])
    np.testing.assert_array_equal(np.concatenate([fit(packed([mask])) for mask in masks]), whole)


def test_inside_and_outside_are_alike():
    rng = np.random.default_rng(2)
    masks = blobs(rng, 90, 31, 8)
    fit = RegionFit(rng.integers(0, 5, (31, 90)) + masks[2], 6)
    np.testing.assert_allclose(fit(packed(masks)), fit(packed(~masks)), atol=1e-12)


def test_the_region_that_looks_different_fits_best_and_at_most_log_2():
    bins = np.zeros((64, 128), dtype=np.int64)
    bins[:, 64:] = 1
    right = bins == 1
    moved = np.stack([np.roll(right, shift, axis=1) for shift in (0, 1, 2, 4, 8, 16)])
    values = RegionFit(bins, 2)(packed(moved))
    assert (np.diff(values) < 0).all()
    assert 0.99 * math.log(2) < values[0] < math.log(2)


def test_nothing_in_common_is_0():
    rng = np.random.default_rng(3)
    fit = RegionFit(rng.integers(0, 100, (30, 40)), 100)
    masks = np.stack(
        [np.zeros((30, 40), dtype=bool), np.ones((30, 40), dtype=bool), rng.random((30, 40)) < 0.5]
    )
    assert fit(packed(masks)).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.slow
def test_threads_and_renderers_change_nothing_and_the_truth_fits_best():
    scene = scene_of(
        *(box([30 * i, 30 * j, 0], [12 + i, 9 + j, 8 + i * j]) for i in range(5) for j in range(5))
    )
    camera, truth = (
        Camera(129, 96, 90.0, 89.0, 64.0, 49.0),
        Pose.from_euler(EulerAngles(35, 1, 20), (80, 20, 110)),
    )
    engine = make_renderer("silhouette", scene, 1)
    noise = np.random.default_rng(4).normal(0, 20, (96, 129))
    photo = np.clip(100 + 60 * engine.render(camera, truth) + noise, 0, 255).astype(np.uint8)
    fit = RegionFit(*appearance_bins(photo, (129, 96)))
    rng = np.random.default_rng(5)
    centers = truth.center + np.concatenate([np.zeros((1, 3)), rng.uniform(-9, 9, (39, 3))])
    rotations = rotations_at_yaws(35.0, 1.0, 20.0 + np.concatenate([[0.0], rng.uniform(-5, 5, 39)]))
    values = engine.fit(camera, rotations, centers, fit)
    assert values.argmax() == 0
    for other in (make_renderer("silhouette", scene, 3), make_renderer("reference", scene, 1)):
        np.testing.assert_array_equal(other.fit(camera, rotations, centers, fit), values)


class TestBins:
    def test_a_grey_photo_has_128_a_colour_photo_864(self):
        grey = np.random.default_rng(6).integers(0, 256, (40, 60), dtype=np.uint8)
        colour = np.random.default_rng(7).integers(0, 256, (40, 60, 3), dtype=np.uint8)
        for photo, count in ((grey, 128), (np.repeat(grey[..., None], 3, axis=2), 128), (colour, 864)):
            found = appearance_bins(photo, (30, 20))
            assert found.num_bins == count
            assert found.bins.shape == (20, 30)
            assert found.bins.max() < count
        np.testing.assert_array_equal(
            appearance_bins(grey, (30, 20)).bins,
            appearance_bins(np.repeat(grey[..., None], 3, 2), (30, 20)).bins,
        )

    def test_brightness_falls_into_equally_full_levels(self):
        ramp = np.tile(np.arange(0, 256, 2, dtype=np.uint8), (32, 1))
        levels = appearance_bins(ramp, (128, 32)).bins // 8
        assert np.bincount(levels.ravel()).tolist() == [32 * 128 // 16] * 16

    def test_exposure_changes_nothing(self):
        photo = np.random.default_rng(8).integers(0, 100, (30, 40), dtype=np.uint8)
        np.testing.assert_array_equal(
            appearance_bins(photo, (40, 30)).bins, appearance_bins(2 * photo + 20, (40, 30)).bins
        )

    def test_a_photo_of_one_colour_says_nothing(self):
        fit = RegionFit(*appearance_bins(np.full((30, 40, 3), 90, dtype=np.uint8), (40, 30)))
        assert fit(packed(blobs(np.random.default_rng(9), 40, 30, 4))).tolist() == [0.0] * 4

    @pytest.mark.parametrize("shape", [(4,), (0, 4), (4, 4, 4)])
    def test_no_photo(self, shape):
        with pytest.raises(RenderingError, match="photo"):
            appearance_bins(np.zeros(shape, dtype=np.uint8), (8, 8))


@pytest.mark.parametrize(("bins", "count"), [([[0, 3]], 3), ([[-1]], 3), ([[0]], 0), ([[0]], 70000)])
def test_bins_out_of_range(bins, count):
    with pytest.raises(RenderingError, match="bins"):
        RegionFit(np.array(bins), count)


def plain_outline(mask, axis):
    """Returns set pixels with an unset one before or after them along an axis."""
    around = np.pad(mask, 1, mode="edge")
    before, after = (
        (around[:-2, 1:-1], around[2:, 1:-1]) if axis == 0 else (around[1:-1, :-2], around[1:-1, 2:])
    )
    return mask & ~(before & after)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_contours_are_the_regions_of_outlines(width, height):
    rng = np.random.default_rng(10)
    masks = blobs(rng, width, height, 9)
    beside, upright = rng.integers(0, 5, (2, height, width))
    expected = [
        RegionFit(beside, 5)(packed([plain_outline(mask, 1)]))
        + RegionFit(upright, 5)(packed([plain_outline(mask, 0)]))
        for mask in masks
    ]
    np.testing.assert_array_equal(ContourFit(beside, upright, 5)(packed(masks)), np.concatenate(expected))


def test_an_outline_on_the_photo_s_edges_fits_best():
    mask = np.zeros((64, 96), dtype=bool)
    mask[20:50, 30:70] = True
    photo = (80 + 60 * mask + np.random.default_rng(11).integers(0, 20, mask.shape)).astype(np.uint8)
    moved = np.stack([np.roll(mask, shift, axis=axis) for axis in (0, 1) for shift in (0, 3, 6)])
    values = ContourFit(*edge_bins(photo, (96, 64), 1.0))(packed(moved))
    assert values[0] == values[3] == values.max() > 0
    assert values[1] < values[0]
    assert values[4] < values[0]
