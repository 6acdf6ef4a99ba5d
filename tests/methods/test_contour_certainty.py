"""What points weigh, which are looked at together, and how sure an answer is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.estimation.outline import OutlinePoints
from lodbench.estimation.outline_alignment import Residuals
from lodbench.estimation.probability import probability_within
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.pose_vector import vector_from_pose
from lodbench.methods.contour_alignment import ContourAlignmentParams
from lodbench.methods.contour_alignment.hypotheses import Hypothesis, Refined, among_rivals, answer_of
from lodbench.methods.contour_alignment.likelihood import TRACKS, _weights, in_chunks


class TestWeights:
    """Points off by as much, outside the mask and inside, seen with outlines of several qualities."""

    @staticmethod
    def weights(noise_px, params):
        distances = np.array([-9.0, -3.0, 3.0, 9.0])
        agreement = np.ones(4)
        here = Residuals(None, distances, None, agreement, 1.0, 1.0)
        slopes = np.zeros((4, 10))
        return _weights(here, slopes, distances, noise_px, TRACKS[0][0][0], params)

    def test_what_a_rough_mask_misses_counts_less_than_what_it_adds(self):
        far_out, out, within, far_within = self.weights(4.0, ContourAlignmentParams())
        assert far_out < out < within
        assert far_out < 0.5 * far_within
        np.testing.assert_array_equal(
            self.weights(4.0, ContourAlignmentParams(hidden_sigmas=3.0)),
            [far_within, within, within, far_within],
        )

    def test_a_fine_mask_misses_as_much_as_it_adds(self):
        far_out, out, within, far_within = self.weights(1.7, ContourAlignmentParams())
        assert (far_out, out) == (far_within, within)

    @given(st.floats(0.5, 5.9))
    def test_no_outline_changes_its_side_at_once(self, noise_px):
        one, other = (self.weights(noise_px + more, ContourAlignmentParams()) for more in (0.0, 1e-6))
        np.testing.assert_allclose(one, other, rtol=1e-4)


class TestDealing:
    @pytest.mark.parametrize("largest", [3, 128, 300])
    def test_every_point_is_dealt_once_and_small_buildings_stay_whole(self, largest):
        generator = np.random.default_rng(largest)
        building = np.repeat(np.arange(30), generator.integers(1, largest + 1, 30))
        count = len(building)
        outline = OutlinePoints(
            generator.uniform(0, 400, (count, 2)), np.zeros((count, 2)), np.ones(count),
            np.zeros((count, 9, 2)), building, np.zeros((count, 2)),
        )  # fmt: skip
        here = Residuals(outline, np.zeros(count), np.zeros((count, 9)), np.ones(count), 1.0, 1.0)
        chunks = in_chunks(here).chunks
        assert sorted(np.concatenate(chunks)) == list(range(count))
        assert max(len(chunk) for chunk in chunks) <= 128
        for number, size in enumerate(np.bincount(building)):
            if size <= 128:
                assert sum(number in building[chunk] for chunk in chunks) == 1


class TestCertainty:
    VECTOR = vector_from_pose(Pose.from_euler(EulerAngles(40, 1, 20), [0, 0, 100]))

    def test_agrees_with_the_distribution_of_a_length(self):
        # A centre with 1 m along each axis is within 2 m with the probability of chi, three degrees.
        spread = np.diag([1.0, 1.0, 1.0, 1e-8, 1e-8, 1e-8])
        assert probability_within(spread, self.VECTOR) == pytest.approx(0.7385, abs=0.03)

    def test_falls_with_the_spread_of_either_part(self):
        sizes = [0.2, 0.7, 1.5, 4.0]
        for part in (slice(0, 3), slice(3, 6)):
            said = []
            for size in sizes:
                spread = np.full(6, 1e-4)
                spread[part] = size**2
                said.append(probability_within(np.diag(spread), self.VECTOR))
            assert said == sorted(said, reverse=True)
            assert said[0] == 1.0
            assert said[-1] < 0.15


class TestAlternatives:
    """Hypotheses that put the camera elsewhere are told, those of one place as one, with their weight."""

    def mixture(self, *places: tuple[float, float]) -> Refined:
        modes = tuple(
            Hypothesis(
                TRACKS[0][0][k], False, False, np.array([east, *[0.0] * 9]), 25.0 * np.eye(10), -float(k)
            )
            for k, (east, _) in enumerate(places)
        )
        weights = np.array([weight for _, weight in places])
        return Refined(np.array([0.0, 0.0, 100.0, 30.0, 0.0, 10.0, 0.0]), modes, weights, 0.9)

    def test_weights_of_one_place_are_added(self):
        answer = answer_of(self.mixture((0.0, 0.6), (10.0, 0.2), (10.5, 0.15), (-20.0, 0.05)))
        np.testing.assert_allclose(answer.alternative_probabilities, [0.35, 0.05])
        np.testing.assert_allclose([pose.center[0] for pose in answer.alternatives], [10.0, -20.0])
        assert answer.probability == pytest.approx(0.6, abs=0.02)

    def test_the_unlikely_and_the_near_are_none(self):
        answer = answer_of(self.mixture((0.0, 0.7), (1.0, 0.29), (30.0, 0.01)))
        assert answer.alternatives == answer.alternative_probabilities == ()


class TestRivals:
    """Other ends of the alignment where the silhouette fits nearly as well as at the answer's."""

    @staticmethod
    def among(places_m, ious):
        start = vector_from_pose(Pose.from_euler(EulerAngles(40.0, 0.0, 20.0), (0.0, 0.0, 50.0)))
        mode = Hypothesis(TRACKS[0][0][0], False, False, np.zeros(10), np.eye(10) * 100.0, 0.0)
        alone = answer_of(Refined(np.append(start, 0.0), (mode,), np.ones(1), 0.9))
        ends = np.tile(np.append(start, 0.0), (len(ious), 1))
        ends[:, 0] += places_m
        return alone, among_rivals(alone, ends, np.array(ious))

    def test_two_places_that_fit_alike_have_half_the_probability_each(self):
        alone, answer = self.among([0.0, 9.0], [0.88, 0.88])
        assert answer.probability == pytest.approx(0.5 * alone.probability)
        assert answer.alternative_probabilities == pytest.approx((0.5,))
        assert answer.alternatives[0].center[0] == pytest.approx(9.0)

    def test_ends_of_one_place_are_no_rivals(self):
        alone, answer = self.among([0.0, 0.4, -1.5, 0.0], [0.88, 0.88, 0.879, 0.87])
        assert answer.probability == alone.probability
        assert answer.alternatives == ()

    @given(st.floats(0.5, 0.87))
    def test_what_fits_worse_takes_less(self, iou):
        alone, answer = self.among([0.0, 9.0], [0.88, iou])
        _, worse = self.among([0.0, 9.0], [0.88, iou - 0.01])
        assert answer.probability <= worse.probability <= alone.probability
        assert worse.probability > 0.9 * alone.probability
