"""What outline points weigh, which are correlated, pitched roofs, and how sure an answer is."""

import gc
import weakref
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lodbench.citymap import CityMap
from lodbench.citymap.city_map import corrected_map
from lodbench.datasets.query import Query
from lodbench.estimation.outline_alignment import OutlinePoints, Residuals
from lodbench.estimation.state_vector import probability_within
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.pose import vector_from_pose
from lodbench.kernels.estimation import add_products, error_covariance, whiten
from lodbench.methods.contour_alignment import ContourAlignment, ContourAlignmentParams
from lodbench.methods.contour_alignment.likelihood import TRACKS, _weights, in_chunks
from lodbench.methods.contour_alignment.method import (
    Hypothesis,
    Refined,
    among_rivals,
    answer_of,
    expected_map,
)
from lodbench.storage import random_stream
from tests.town import CAMERA, prior_of


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
        return alone, among_rivals(alone, ends, np.array(ious), np.zeros(len(ious)))

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


@pytest.fixture
def told(scene):
    """The town's map, of whose buildings every other one is told to have a pitched roof."""
    return CityMap(replace(scene, pitched=np.arange(scene.num_buildings) % 2 == 0), threads=1)


def tops(scene):
    return np.maximum.reduceat(scene.vertices[:, 2], scene.vertex_starts[:-1])


def test_it_is_made_once_for_a_map(told, scene):
    expected = expected_map(told, 0.3)
    np.testing.assert_allclose(tops(scene) - tops(expected.scene), 0.3 * told.scene.pitched, atol=1e-4)
    assert expected_map(told, 0.3) is expected
    assert expected_map(told, 1.0) is not expected


def test_a_map_of_which_nothing_is_told_stays(told, city_map):
    for _ in range(2):
        assert expected_map(city_map, 1.0) is city_map
        assert expected_map(told, 0.0) is told


def test_a_map_that_is_no_longer_needed_is_freed(scene):
    for pitched in (None, np.ones(scene.num_buildings, bool)):
        city_map = CityMap(replace(scene, pitched=pitched), threads=1)
        expected_map(city_map, 1.0)
        reference = weakref.ref(city_map)
        del city_map
        gc.collect()
        assert reference() is None


@pytest.mark.slow
def test_told_roofs_bring_the_answer_nearer(told, truths):
    """Masks of a town whose every other roof is two metres lower than in the map, which tells which."""
    town, _ = corrected_map(told, np.where(told.scene.pitched, -2.0, 0.0))
    errors = {0.0: [], 2.0: []}
    for number, truth in enumerate(truths):
        mask = town.render(CAMERA, truth).astype(np.float32)
        query = Query(f"q{number}", "all", CAMERA, prior_of(truth), mask)
        for lower_m, found in errors.items():
            method = ContourAlignment(ContourAlignmentParams(pitched_lower_m=lower_m))
            estimate = method.localize(query, told, partial(random_stream, 0, "test"))
            found.append(pose_error(estimate.pose, truth).translation_m)
    assert np.mean(errors[2.0]) < 0.5 * np.mean(errors[0.0])


@pytest.fixture(scope="module")
def points():
    generator = np.random.default_rng(3)
    rises, feet = generator.normal(size=(2, 40))
    return generator.uniform(0, 300, (40, 2)), rises, feet, generator.integers(0, 4, 40)


def test_covariance_is_the_sum_of_what_is_shared(points):
    pixels, rises, feet, buildings = points
    matrix = error_covariance(*points, (2.0, 0.5), (30.0, 60.0), (4.0, 9.0, 2.5))
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    own = np.outer(rises, rises) * (4.0 + 9.0 * np.exp(-apart / 60.0)) + 2.5 * np.outer(feet, feet)
    same = buildings[:, None] == buildings[None]
    lags = np.sqrt(3.0) * apart / 30.0
    expected = 2.0 * (1.0 + lags) * np.exp(-lags) + np.where(same, own, 0.0) + 0.5 * np.eye(40)
    np.testing.assert_allclose(matrix, np.tril(expected), rtol=1e-12)


@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
@settings(deadline=None, max_examples=30)
def test_whitened_products_are_those_of_the_inverse(seed, count):
    generator = np.random.default_rng(seed)
    root = generator.normal(size=(count, count))
    matrix = root @ root.T + 0.1 * np.eye(count)
    columns = generator.normal(size=(count, 7))
    whitened = columns.copy()
    log_determinant = whiten(np.tril(matrix), whitened)
    np.testing.assert_allclose(
        whitened.T @ whitened, columns.T @ np.linalg.solve(matrix, columns), rtol=1e-6, atol=1e-9
    )
    assert log_determinant == pytest.approx(np.linalg.slogdet(matrix)[1], abs=1e-6)


@pytest.mark.parametrize("count", [1, 3, 4, 9, 30])
def test_products_of_columns_are_added_to_the_upper_half(count):
    generator = np.random.default_rng(count)
    columns, before = generator.normal(size=(count, 6)), generator.normal(size=(6, 6))
    products = before.copy()
    add_products(columns, 0.25, products)
    np.testing.assert_allclose(np.triu(products), np.triu(before + 0.25 * columns.T @ columns), atol=1e-12)
