"""The fits against plain numpy, pixel by pixel."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hostile_scenes import blobs, box, packed, scene_of
from hypothesis import given
from hypothesis import strategies as st

from lodbench.errors import RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotations_at_yaws
from lodbench.rendering import (
    BoundaryFit,
    ContourFit,
    IouFit,
    RegionFit,
    SemanticIouFit,
    SoftIouFit,
    appearance_bins,
    edge_bins,
    make_renderer,
)

SIZES = [(1, 1), (1, 9), (63, 5), (64, 7), (65, 1), (127, 30), (128, 12), (150, 41)]


def outline(mask):
    """Returns the rows and columns of set pixels beside an unset one."""
    around = np.pad(mask, 1, mode="edge")
    inner = around[:-2, 1:-1] & around[2:, 1:-1] & around[1:-1, :-2] & around[1:-1, 2:]
    return np.argwhere(mask & ~inner)


def octagonal(a, b):
    """Returns the distance of each pixel of a to the nearest of b, by the closed form of the metric."""
    steps = np.abs(a[:, None] - b[None])
    return np.maximum(steps.max(axis=2), -(-2 * steps.sum(axis=2) // 3)).min(axis=1)


def plain_boundary(mask, query, reach):
    a, b = outline(mask), outline(query)
    if len(a) == 0 or len(b) == 0:
        return 0.0
    mean = sum(np.minimum(octagonal(p, q), reach).mean() for p, q in ((a, b), (b, a)))
    return 1.0 - mean / (2 * reach)


@pytest.mark.parametrize(("width", "height"), SIZES)
class TestAgainstPlainNumpy:
    def test_iou(self, width, height):
        rng = np.random.default_rng(1)
        masks, queries = blobs(rng, width, height, 9), blobs(rng, width, height, 5)
        for query in queries:
            expected = [(m & query).sum() / max(1, (m | query).sum()) for m in masks]
            np.testing.assert_array_equal(IouFit(query)(packed(masks)), expected)

    def test_semantic_iou(self, width, height):
        rng = np.random.default_rng(5)
        drawn, query = rng.integers(0, 3, (2, 6, height, width)).astype(np.uint8)
        query[1][query[1] == 2] = 0
        query[2] = 0
        for wanted in query:
            ious = [
                [((m == k) & (wanted == k)).sum() / ((m == k) | (wanted == k)).sum() for m in drawn]
                for k in (1, 2)
                if (wanted == k).any()
            ]
            expected = np.mean(ious, axis=0) if ious else np.zeros(6)
            np.testing.assert_array_equal(SemanticIouFit(wanted)(drawn), expected)

    def test_weighted_iou_of_a_mask(self, width, height):
        rng = np.random.default_rng(2)
        masks, query = blobs(rng, width, height, 9), blobs(rng, width, height, 4)[3]
        # Whole 2**16ths of the largest, so that the sums are exact.
        steps = rng.integers(0, 2**16 + 1, (height, width))
        steps[0, 0] = 2**16
        values = SoftIouFit(query.astype(float), steps / 2**12)(packed(masks))
        for mask, value in zip(masks, values, strict=True):
            union = int(steps[mask | query].sum())
            assert value == (float(Fraction(int(steps[mask & query].sum()), union)) if union else 0.0)

    def test_soft_iou(self, width, height):
        rng = np.random.default_rng(3)
        masks, weights = blobs(rng, width, height, 9), rng.uniform(0.1, 5.0, (height, width))
        p = rng.uniform(0.0, 1.0, (height, width))
        for w, fit in ((np.ones_like(p), SoftIouFit(p)), (weights, SoftIouFit(p, weights))):
            expected = [(w * np.minimum(p, m)).sum() / (w * np.maximum(p, m)).sum() for m in masks]
            np.testing.assert_allclose(fit(packed(masks)), expected, atol=2e-4)

    def test_boundary(self, width, height):
        rng = np.random.default_rng(4)
        masks, queries = blobs(rng, width, height, 9), blobs(rng, width, height, 5)
        for query in queries:
            for reach in (1, 2, 7):
                fit = BoundaryFit(query, reach)
                expected = [plain_boundary(mask, query, reach) for mask in masks]
                np.testing.assert_allclose(fit(packed(masks)), expected, atol=1e-12)


def test_a_soft_mask_of_0_and_1_is_the_iou_to_the_bit():
    rng = np.random.default_rng(5)
    masks = blobs(rng, 130, 40, 12)
    query = masks[6]
    np.testing.assert_array_equal(
        SoftIouFit(query.astype(float))(packed(masks)), IouFit(query)(packed(masks))
    )


def test_an_empty_query_and_an_empty_silhouette_fit_nothing():
    empty = np.zeros((5, 70), dtype=bool)
    for fit in (IouFit(empty), SoftIouFit(empty.astype(float)), BoundaryFit(empty)):
        assert fit(packed([empty])).tolist() == [0.0]


def test_an_outline_moved_sideways_is_that_far_away():
    mask = np.zeros((60, 200), dtype=bool)
    mask[:, 20:100] = True  # it reaches the upper and lower border, where there is no outline
    moved = np.roll(mask, 5, axis=1)
    # A mean distance of 5 of the 16 pixels that count.
    assert BoundaryFit(mask, 16)(packed([mask, moved])).tolist() == pytest.approx([1.0, 1.0 - 5 / 16])
    assert BoundaryFit(mask, 4)(packed([moved])).tolist() == [0.0]


class TestThroughTheEngine:
    CAMERA = Camera(129, 96, 90.0, 89.0, 64.0, 49.0)
    SCENE = scene_of(
        *(box([30 * i, 30 * j, 0], [12 + i, 9 + j, 8 + i * j]) for i in range(5) for j in range(5))
    )

    def hypotheses(self, count):
        rng = np.random.default_rng(6)
        centers = rng.uniform([-40, -60, 30], [200, 200, 140], (count, 3))
        return rotations_at_yaws(40.0, 1.0, rng.uniform(-180, 180, count)), centers

    def fits(self, mask):
        p = np.clip(0.8 * mask + 0.1, 0, 1)
        return [IouFit(mask), SoftIouFit(p), SoftIouFit(mask.astype(float), 1.1 - p), BoundaryFit(mask)]

    def test_threads_batches_and_renderers_change_nothing(self):
        engine = make_renderer("silhouette", self.SCENE, 1)
        mask = engine.render(self.CAMERA, Pose.from_euler(EulerAngles(35, 1, 20), (80, 20, 110)))
        rotations, centers = self.hypotheses(30)
        for fit in self.fits(mask):
            whole = engine.fit(self.CAMERA, rotations, centers, fit)
            assert len(set(whole)) > 10
            parts = [
                engine.fit(self.CAMERA, rotations[i : i + 4], centers[i : i + 4], fit)
                for i in range(0, 30, 4)
            ]
            np.testing.assert_array_equal(np.concatenate(parts), whole)
            for other in (make_renderer("silhouette", self.SCENE, 3), make_renderer("raster", self.SCENE, 1)):
                np.testing.assert_array_equal(other.fit(self.CAMERA, rotations, centers, fit), whole)

    def test_iou_is_that_of_score(self):
        engine = make_renderer("silhouette", self.SCENE, 2)
        mask = engine.render(self.CAMERA, Pose.from_euler(EulerAngles(35, 1, 20), (80, 20, 110)))
        poses = self.hypotheses(20)
        counts = engine.counts(self.CAMERA, *poses, mask)
        np.testing.assert_array_equal(engine.fit(self.CAMERA, *poses, IouFit(mask)), counts.iou())

    def test_one_s_own_fit(self):
        class Area:
            """The share of the picture that is building: what a new cost needs, and no more."""

            size = (129, 96)

            def __call__(self, words):
                return np.array([np.unpackbits(w.view(np.uint8)).mean() for w in words])

        engine = make_renderer("silhouette", self.SCENE, 1)
        rotations, centers = self.hypotheses(5)
        areas = engine.fit(self.CAMERA, rotations, centers, Area())
        drawn = [
            engine.render(self.CAMERA, Pose.from_center(r, c)).sum() / (192 * 96)
            for r, c in zip(rotations, centers, strict=True)
        ]
        np.testing.assert_allclose(areas, drawn)

    @pytest.mark.parametrize("name", ["silhouette", "reference"])
    def test_a_fit_of_another_size_is_refused(self, name):
        fit = IouFit(np.ones((48, 64), dtype=bool))
        with pytest.raises(RenderingError, match="64 x 48"):
            make_renderer(name, self.SCENE, 1).fit(self.CAMERA, *self.hypotheses(1), fit)


class TestWhatIsRefused:
    @pytest.mark.parametrize("value", [-0.1, 1.1, np.nan])
    def test_probabilities_out_of_range(self, value):
        with pytest.raises(RenderingError, match=r"\[0, 1\]"):
            SoftIouFit(np.full((4, 4), value))

    @pytest.mark.parametrize(
        "weights", [np.ones((4, 5)), np.zeros((4, 4)), np.full((4, 4), np.inf), np.full((4, 4), -1.0)]
    )
    def test_weights_that_weigh_nothing(self, weights):
        with pytest.raises(RenderingError, match="weights"):
            SoftIouFit(np.ones((4, 4)), weights)

    def test_no_picture(self):
        for shape in ((4,), (0, 4), (2, 4, 4)):
            with pytest.raises(RenderingError, match="height, width"):
                IouFit(np.ones(shape, dtype=bool))

    def test_no_reach(self):
        with pytest.raises(RenderingError, match="reach_px"):
            BoundaryFit(np.ones((4, 4), dtype=bool), 0)


REGION_SIZES = [(1, 1), (1, 9), (63, 5), (64, 7), (65, 1), (127, 30), (150, 41)]


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


@pytest.mark.parametrize(("width", "height"), REGION_SIZES)
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


@pytest.mark.parametrize(("width", "height"), REGION_SIZES)
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
