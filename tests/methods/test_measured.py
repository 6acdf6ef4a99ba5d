"""What is measured beside a photo reaches search, prior and covariance of methods, and of flights."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.contour_alignment import ContourAlignment, ContourAlignmentParams
from lodbench.methods.flight import FlightParams
from lodbench.methods.flight.joint import solve
from lodbench.methods.flight.roof_parts import RoofParts
from lodbench.methods.flight.state import State, without_odd_heights
from lodbench.methods.region import RegionParams
from lodbench.methods.region.evidence import PosePosterior
from lodbench.methods.timed_localize import localize_query
from lodbench.photos.measurements import Measurements
from lodbench.photos.xmp import LaserRange
from lodbench.storage import random_stream

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
