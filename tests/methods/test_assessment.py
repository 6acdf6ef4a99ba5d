"""How far answers are trusted; what is measured beside a photo reaches search, prior and covariance."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from lodbench.datasets.query import Query
from lodbench.estimation.edge_alignment import LensErrors, PhotoEdges, lines_in_view, project_lines
from lodbench.estimation.state_vector import probability_within
from lodbench.geometry.camera import CALIBRATED, UNKNOWN, CameraSigmas
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.assessment import assessed, camera_columns, edge_excess
from lodbench.methods.contour_alignment import ContourAlignment, ContourAlignmentParams
from lodbench.methods.flight import FlightParams
from lodbench.methods.flight.joint import State, solve, without_odd_heights
from lodbench.methods.flight.photo_terms import RoofParts
from lodbench.methods.localize import localize_query
from lodbench.methods.protocol import Estimate
from lodbench.methods.region import RegionParams
from lodbench.methods.region.posteriors import PosePosterior
from lodbench.photos.measurements import Measurements
from lodbench.photos.xmp import LaserRange
from lodbench.storage import random_stream
from tests.methods.flight.test_shared_looks import painted
from tests.town import CAMERA, prior_of

SURE = np.diag([0.05, 0.05, 0.05, 0.02, 0.02, 0.05]) ** 2
# Photos are looked at no wider than 1200 pixels.
WIDE = CAMERA.scaled(960, 720)
PRIOR_SIGMAS = np.array([5.0, 5.0, 15.0, 0.5, 0.5, 4.0])


@pytest.fixture(scope="module")
def photos(city_map, truths, tmp_path_factory):
    """Returns queries with a photo each, whose cameras are calibrated."""
    folder, generator = tmp_path_factory.mktemp("photos"), np.random.default_rng(3)
    found = []
    for number, truth in enumerate(truths):
        path = folder / f"q{number}.png"
        cv2.imwrite(str(path), painted(city_map, truth, 1.0, generator, WIDE))
        found.append(Query(path.name, "all", WIDE, prior_of(truth), image=path))
    return found


@pytest.fixture(scope="module")
def bare(truths):
    """Returns a query without a photo."""
    return Query("q", "all", CAMERA, prior_of(truths[0]))


def answer(pose, covariance=SURE, probability=0.99, **rest):
    return Estimate(pose, 1.0, covariance=covariance, probability=probability, **rest)


def at_answer(city_map, pose, camera=CAMERA):
    lines = lines_in_view(city_map, camera, pose, 4.0)
    lines = lines.of(lines.relative_heights > 0.2)
    return lines, project_lines(lines.points, lines.along, camera, vector_from_pose(pose), LensErrors())


@pytest.mark.parametrize("spread", [0.2, 1.0, 3.0, 10.0])
@pytest.mark.parametrize("is_camera_solved", [True, False])
def test_no_probability_exceeds_what_the_covariance_allows(city_map, bare, truths, spread, is_camera_solved):
    covariance = np.diag([spread, spread, spread, 0.2 * spread, 0.2 * spread, 0.3 * spread]) ** 2
    found = assessed(answer(truths[0], covariance), bare, city_map, None, is_camera_solved)
    vector = vector_from_pose(truths[0])
    # Independent draws: within 2 m, with half of the variance, whatever the angles say.
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(3), 0.5 * covariance[:3, :3], 200_000)
    most = float((np.linalg.norm(drawn, axis=1) < 2.0).mean())
    assert found.probability <= min(0.99, most + 0.02)
    assert found.probability <= probability_within(0.5 * covariance, vector) + 1e-9
    # Nor does it rise: a method that is less sure knows why.
    doubtful = assessed(answer(truths[0], covariance, 0.0005), bare, city_map, None, is_camera_solved)
    assert doubtful.probability == 0.0005
    np.testing.assert_array_equal(found.pose.center, truths[0].center)


def test_an_answer_without_a_probability_or_a_covariance_states_none_afterwards(city_map, bare, truths):
    silent = Estimate(truths[0], 1.0, covariance=SURE)
    assert assessed(silent, bare, city_map) is silent
    found = assessed(answer(truths[0], None, 0.7), bare, city_map)
    assert found.covariance is None
    assert found.probability == 0.7


def test_columns_of_the_camera_are_where_least_squares_ends_with_another_camera(city_map, truths):
    """Gauss-Newton on the same lines, which the solver takes to be seen through another lens."""
    for truth in truths:
        lines, laid = at_answer(city_map, truth)
        columns = camera_columns(laid, lines, PRIOR_SIGMAS)
        weights = lines.lengths_px / (40.0 * 2.0**2)
        start, seen = vector_from_pose(truth), laid.pixels
        for number, size in enumerate((0.002, 0.002, 0.001, 0.001)):
            lens = LensErrors(*(size * np.eye(4)[number]))
            vector = start
            for _ in range(6):
                here = project_lines(lines.points, lines.along, CAMERA, vector, lens)
                off = ((here.pixels - seen) * here.normals).sum(axis=1)
                slopes = here.by_camera[:, :6]
                curvature = (slopes.T * weights) @ slopes + np.diag(PRIOR_SIGMAS**-2.0)
                pull = (slopes.T * weights) @ off + PRIOR_SIGMAS**-2.0 * (vector - start)
                vector = vector - np.linalg.solve(curvature, pull)
            moved = vector - start
            np.testing.assert_allclose(
                size * columns[:, number], moved, atol=0.06 * np.abs(moved).max(), err_msg=str(number)
            )


def test_a_camera_that_is_little_known_costs_probability_and_stands_in_the_covariance(city_map, bare, truths):
    calibrated = assessed(answer(truths[0]), replace(bare, camera_sigmas=CALIBRATED), city_map)
    unsaid = assessed(answer(truths[0]), bare, city_map)
    unknown = assessed(answer(truths[0]), replace(bare, camera_sigmas=UNKNOWN), city_map)
    np.testing.assert_array_equal(calibrated.covariance, SURE)
    assert calibrated.probability == unsaid.probability
    # Even a calibrated one may be of another camera: one in seven.
    assert 0.85 <= calibrated.probability < 0.95
    assert calibrated.notes == ()
    assert unknown.probability < 0.8 * calibrated.probability
    added = unknown.covariance - SURE
    assert np.linalg.eigvalsh(added).min() > -1e-9
    lines, laid = at_answer(city_map, truths[0])
    columns = camera_columns(laid, lines, np.array([10.0, 10.0, 30.0, 1.0, 1.0, 7.5]) / np.sqrt(3.0))
    columns = columns * np.array([0.015, 0.03, 0.007, 0.007])
    np.testing.assert_allclose(added, columns @ columns.T, rtol=1e-6, atol=1e-9)
    (note,) = unknown.notes
    worst = np.linalg.norm(columns[:3], axis=0).max()
    assert f"is {worst:.1f} m here" in note
    # A flight has solved for it.
    solved = assessed(answer(truths[0]), replace(bare, camera_sigmas=UNKNOWN), city_map, None, True)
    np.testing.assert_array_equal(solved.covariance, SURE)
    assert solved.probability == 0.99


def test_what_the_method_has_allowed_for_counts_once(city_map, bare, truths):
    sigmas = CameraSigmas(1.5, 0.0, 0.0, "nominal")
    known = replace(bare, camera_sigmas=sigmas, lens_percent=1.5)
    np.testing.assert_array_equal(assessed(answer(truths[0]), known, city_map).covariance, SURE)
    half = replace(bare, camera_sigmas=sigmas, lens_percent=1.2)
    whole = replace(bare, camera_sigmas=sigmas)
    added = [assessed(answer(truths[0]), query, city_map).covariance - SURE for query in (half, whole)]
    np.testing.assert_allclose(added[0], (0.9 / 1.5) ** 2 * added[1], rtol=1e-6, atol=1e-9)


def test_an_answer_that_the_photos_edges_contradict_is_in_doubt_and_the_true_one_is_not(
    city_map, photos, truths
):
    for query, truth in zip(photos, truths, strict=True):
        right = assessed(answer(truth), query, city_map)
        assert right.probability > 0.8
        assert right.notes == ()
        # Aside of both directions that walls run in: lines moved along themselves stay on their edges.
        for offset in ([3.5, -3.5, 0.0], [-3.0, 3.0, 3.0], [3.0, 3.0, 3.0]):
            wrong = assessed(answer(truth.shifted(offset)), query, city_map)
            assert wrong.probability == 0.45
            assert "poor fit: edges in the photo" in wrong.notes[-1]


def test_lines_on_edges_are_more_than_by_chance_at_the_truth_and_few_lines_say_nothing(
    city_map, photos, truths
):
    picture = PhotoEdges(cv2.imread(str(photos[0].image)), (WIDE.width, WIDE.height))
    lines, laid = at_answer(city_map, truths[0], WIDE)
    assert edge_excess(picture, laid) > 0.4
    noise = np.random.default_rng(0).integers(0, 256, (WIDE.height, WIDE.width, 3), dtype=np.uint8)
    assert abs(edge_excess(PhotoEdges(noise, picture.size), laid)) < 0.1
    blank = np.full(noise.shape, 120, dtype=np.uint8)
    assert edge_excess(PhotoEdges(blank, picture.size), laid) is None
    few = lines.of(np.arange(len(lines)) < 29)
    laid = project_lines(few.points, few.along, WIDE, vector_from_pose(truths[0]), LensErrors())
    assert edge_excess(picture, laid) is None


@pytest.mark.parametrize(("higher_m", "is_at_bound"), [(14.9, True), (-14.9, True), (14.0, False)])
def test_a_height_at_the_bound_of_the_search_is_in_doubt(city_map, bare, truths, higher_m, is_at_bound):
    query = replace(bare, prior=truths[0].shifted([0.0, 0.0, -higher_m]))
    found = assessed(answer(truths[0]), query, city_map, SimpleNamespace(range_z_m=30.0))
    assert (found.probability == 0.45) == is_at_bound
    assert any(f"{higher_m:+.1f} m from the prior" in note for note in found.notes) == is_at_bound
    # A method that states no range has no bound.
    assert assessed(answer(truths[0]), query, city_map).notes == ()


STREAMS = partial(random_stream, 0, "test")
RTK = Measurements((0.05, 0.05, 0.08, None, None, None))
SMALL = ContourAlignmentParams(coarse_size=(160, 120), fine_size=(320, 240), noise_px=0.5, roof_m=0.0)


@pytest.mark.parametrize("params", [RegionParams(), ContourAlignmentParams()], ids=lambda p: p.name)
def test_the_search_is_as_wide_as_three_stated_deviations(params):
    found = params.over_measured(Measurements((0.5, 20.0, None, 0.2, None, 100.0)))
    assert (found.range_x_m, found.range_y_m, found.range_z_m) == (3.0, 120.0, params.range_z_m)
    assert found.range_yaw_deg == 360.0
    # Pitch and roll have one range: the wider of what is stated of one and declared of the other.
    assert found.range_tilt_deg == params.range_tilt_deg
    both = params.over_measured(Measurements((None, None, None, 0.2, 0.1, None)))
    assert both.range_tilt_deg == pytest.approx(1.2)
    assert params.over_measured(None) is params
    assert params.over_measured(Measurements(laser=LaserRange(9.0))) is params


def test_the_prior_of_region_has_the_stated_deviations(queries, city_map):
    class Size:
        size = (64, 48)

    def sigmas(measured):
        query = replace(queries[0], measured=measured)
        return PosePosterior(query, city_map, Size(), RegionParams().over_measured(measured)).prior.sigmas

    np.testing.assert_array_equal(sigmas(None), RegionParams().prior_sigmas())
    np.testing.assert_array_equal(sigmas(RTK)[:3], [0.05, 0.05, 0.08])
    np.testing.assert_array_equal(sigmas(RTK)[3:], RegionParams().prior_sigmas()[3:])


@pytest.fixture(scope="module")
def answers(queries, truths, city_map):
    """Of the first view: without, with an RTK receiver's place, and the same with a wildly wrong range."""
    near = pose_from_vector(vector_from_pose(truths[0]) + np.array([0.04, -0.05, 0.07, 0.3, -0.2, 2.0]))
    method = ContourAlignment(SMALL)

    def answer(**changes):
        return localize_query(method, replace(queries[0], **changes), city_map, STREAMS)

    wrong = replace(RTK, laser=LaserRange(999.0))
    return answer(prior=near), answer(prior=near, measured=RTK), answer(prior=near, measured=wrong)


def test_a_stated_deviation_narrows_search_answer_and_covariance(answers, truths):
    without, known, _ = answers
    assert known.hypotheses < 0.5 * without.hypotheses
    gained = np.linalg.eigvalsh((without.covariance - known.covariance)[:3, :3])
    assert gained.min() > 0.0
    assert np.sqrt(np.trace(known.covariance[:3, :3])) < 0.12
    assert np.linalg.norm(known.pose.center - truths[0].center) < 0.2


def test_a_wildly_wrong_range_changes_no_pose(answers):
    _, known, wrong = answers
    np.testing.assert_array_equal(wrong.pose.cam_from_world, known.pose.cam_from_world)
    np.testing.assert_array_equal(wrong.covariance, known.covariance)
    assert not wrong.is_laser_used
    assert any("the laser measured 999.0 m" in note for note in wrong.notes)


HEIGHTS = np.array([0.0, 3.0, -2.0, 7.0, 1.5])


def flight_state(measured, errors_m):
    priors = np.zeros((len(HEIGHTS), 6))
    priors[:, 0], priors[:, 2] = 10.0 * np.arange(len(HEIGHTS)), 100.0 + HEIGHTS + errors_m
    weights = np.ones(len(HEIGHTS))
    return State(priors, priors, RoofParts(20.0, 0), np.zeros(0), weights, measured=measured)


def heights_after(state, params):
    for _ in range(12):
        state.step(solve(state, [None] * len(HEIGHTS), params))
    return state.vectors[:, 2]


def test_air_pressure_says_how_heights_of_a_flight_differ_and_not_how_high_they_are():
    errors_m = np.array([1.0, -0.8, 0.6, -1.2, 0.4])
    measured = [Measurements(takeoff_height_m=float(h), takeoff_sigma_m=0.01) for h in HEIGHTS]
    found = heights_after(flight_state(measured, errors_m), FlightParams())
    np.testing.assert_allclose(found - found[0], HEIGHTS, atol=0.02)
    np.testing.assert_allclose(found.mean(), 100.0 + (HEIGHTS + errors_m).mean(), atol=0.01)
    alone = heights_after(flight_state((), errors_m), FlightParams())
    np.testing.assert_allclose(alone, 100.0 + HEIGHTS + errors_m)


def test_one_height_above_take_off_says_nothing():
    errors_m = np.array([1.0, -0.8, 0.6, -1.2, 0.4])
    measured = [Measurements(takeoff_height_m=500.0), None, None, None, None]
    found = heights_after(flight_state(measured, errors_m), FlightParams())
    np.testing.assert_allclose(found, 100.0 + HEIGHTS + errors_m)


def test_heights_that_are_all_zero_are_none():
    priors = np.zeros((5, 6))
    priors[:, 2] = 40.0 * np.arange(5)
    zeros = [Measurements(takeoff_height_m=0.0)] * 5
    assert all(each.takeoff_height_m is None for each in without_odd_heights(zeros, priors))
    assert without_odd_heights(zeros, np.zeros((5, 6))) == zeros
    assert without_odd_heights([None, None], np.zeros((2, 6))) == [None, None]


def test_photos_of_a_flight_have_deviations_of_their_own():
    state = flight_state([RTK, None, None, None, None], np.zeros(5))
    usual = FlightParams().own_sigmas()
    found = state.own_sigmas(usual)
    np.testing.assert_array_equal(found[0], [*RTK.sigmas[:3], *usual[3:]])
    np.testing.assert_array_equal(found[1:], np.tile(usual, (4, 1)))
    assert state.begun(np.array([0, 2]), np.zeros(6)).measured == [RTK, None]


def test_a_flight_shares_no_more_than_the_worst_of_its_photos_states():
    params = FlightParams()
    assert params.with_measured([RTK, None]) == params
    found = params.with_measured([RTK, replace(RTK, sigmas=(0.2, 0.1, 0.3, None, None, None))])
    np.testing.assert_allclose(found.shared_sigmas()[:3], [0.2, 0.2, 0.3])
    np.testing.assert_array_equal(found.shared_sigmas()[3:], params.shared_sigmas()[3:])
