"""The fits against plain numpy, pixel by pixel."""

from fractions import Fraction

import numpy as np
import pytest
from hostile_scenes import box, scene_of
from mask_blobs import blobs, packed

from lodbench.errors import RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotations_at_yaws
from lodbench.rendering import BoundaryFit, IouFit, SemanticIouFit, SoftIouFit, make_renderer

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
