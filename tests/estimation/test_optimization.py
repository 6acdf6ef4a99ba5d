"""Normal equations with errors of unknown scale, the evolution search, and priors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.estimation.optimization import (
    ErrorGroup,
    NormalEquations,
    Quadratic,
    maximize,
    maximize_abreast,
)
from lodbench.estimation.state_vector import Gaussian, Prior, differences, shortened

TOLD = 2.0


def scale_found(errors, noise, members=None, rounds=30):
    """Returns the scale of (N,) differences from a common number, each measured with noise, told as 2."""
    count, scale = len(errors), 1.0
    measured = np.random.default_rng(1).normal(errors, noise)
    values = np.zeros(count + 1)
    for _ in range(rounds):
        equations = NormalEquations(count + 1)
        group = ErrorGroup(equations, scale)
        rows = np.arange(count)
        equations.add(rows, np.eye(count) / noise**2, (values[:-1] - measured) / noise**2)
        equations.add(np.array([count]), np.eye(1) * 1e-6, 1e-6 * values[-1:])
        precisions = np.full(count, (scale * TOLD) ** -2.0)
        group.add_differences(rows, np.full(count, count), values[:-1] - values[-1], precisions)
        factorised, step = equations.solve()
        scale = group.scale_after(factorised, step, count if members is None else members)
        values = values + step
    return scale


@pytest.mark.parametrize("spread", [0.3, 0.6, 1.2])
def test_the_spread_of_many_errors_is_found(spread):
    errors = np.random.default_rng(0).normal(5.0, spread, 400)
    assert scale_found(errors, 0.2) * TOLD == pytest.approx(spread, rel=0.15)
    # Measured no better than they err.
    assert scale_found(errors, spread) * TOLD == pytest.approx(spread, rel=0.25)


def test_what_is_not_measured_stays_as_told():
    assert scale_found(np.zeros(50), 200.0) > 0.95


def test_errors_are_never_larger_than_told():
    assert scale_found(np.random.default_rng(0).normal(0.0, 5.0, 100), 0.2) == 1.0


def test_few_errors_that_have_nothing_to_do_with_each_other_move_little():
    errors = np.random.default_rng(0).normal(0.0, 0.2, 100)
    many, few = (scale_found(errors, 0.1, members) for members in (100, 1))
    assert many < 0.15
    assert few > 0.5


def test_residuals_of_several_numbers_count_as_they_are_whitened():
    generator = np.random.default_rng(2)
    root = generator.normal(size=(3, 3)) + 3.0 * np.eye(3)
    information = root @ root.T
    residuals = [np.linalg.solve(root.T, 0.4 * generator.normal(size=3)) for _ in range(200)]
    equations = NormalEquations(1)
    group = ErrorGroup(equations, 1.0)
    equations.add(np.array([0]), np.eye(1), np.zeros(1))
    for residual in residuals:
        group.add_residuals(np.array([0]), np.zeros((3, 1)), residual, information)
    factorised, step = equations.solve()
    assert group.count == 600
    assert group.scale_after(factorised, step, 600) == pytest.approx(0.4, rel=0.1)
    assert ErrorGroup(equations, 0.7).scale_after(factorised, step, 0) == 0.7


@pytest.mark.parametrize("information", [np.zeros((3, 3)), np.outer([1.0, 2.0, 3.0], [1.0, 2.0, 3.0])])
def test_residuals_that_say_nothing_along_a_direction_have_a_scale(information):
    equations = NormalEquations(1)
    group = ErrorGroup(equations, 1.0)
    equations.add(np.array([0]), np.eye(1), np.zeros(1))
    for _ in range(20):
        group.add_residuals(np.array([0]), np.ones((3, 1)), np.full(3, 0.01), information)
    factorised, step = equations.solve()
    assert 0.1 <= group.scale_after(factorised, step, 60) < 1.0


@given(st.integers(0, 2**32))
def test_a_climb_ends_on_the_top_of_a_tilted_valley(seed):
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    curvature = turn * np.logspace(0, 3, 6) @ turn.T
    top = rng.normal(size=6)

    def value(points):
        return -0.5 * np.einsum("ni,ij,nj->n", points - top, curvature, points - top)

    found = maximize(value, Gaussian(np.zeros(6), np.eye(6)), 120, 24, rng)
    assert value(found.mean[None])[0] > -1e-3
    # The cloud takes the valley's shape: longest where the curvature is least.
    lengths, axes = np.linalg.eigh(found.covariance)
    assert abs(axes[:, -1] @ turn[:, 0]) > 0.7
    assert (lengths > 0).all()


def two_hills(lower):
    """Returns the value of points (N, 6) near hills of height 0 at 0 and of another one at 100."""

    def value(points):
        return -np.minimum((points**2).sum(axis=1), -lower + ((points - 100.0) ** 2).sum(axis=1))

    return value


def generators():
    return [np.random.default_rng(seed) for seed in range(3)]


STARTS = [Gaussian(np.full(6, place), np.eye(6)) for place in (1.0, 99.0, -2.0)]


def test_searches_abreast_end_where_each_does_by_itself():
    value = two_hills(-30.0)
    together = maximize_abreast(value, STARTS, 22, 24, generators(), prune_gap=100.0)
    for found, start, generator in zip(together, STARTS, generators(), strict=True):
        alone = maximize(value, start, 22, 24, generator)
        np.testing.assert_allclose(found.mean, alone.mean, atol=1e-9)
        np.testing.assert_allclose(found.covariance, alone.covariance, atol=1e-9)


def test_a_search_that_is_far_behind_is_given_up_and_the_others_go_on():
    asked = []

    def value(points):
        asked.append(len(points))
        return two_hills(-1000.0)(points)

    found = maximize_abreast(value, STARTS, 22, 24, generators(), prune_gap=100.0)
    assert asked == [3 * 24] * 4 + [2 * 24] * 18
    assert [round(float(np.abs(cloud.mean).max())) for cloud in found] == [0, 0]
    whole = maximize_abreast(value, STARTS, 22, 24, generators())
    for one, other in zip(found, [whole[0], whole[2]], strict=True):
        np.testing.assert_allclose(one.mean, other.mean, atol=1e-9)


def test_nothing_climbs_from_nowhere():
    assert maximize_abreast(two_hills(0.0), [], 22, 24, []) == []


MEAN = np.array([10.0, -5.0, 100.0, 30.0, 1.0, 175.0])
SIGMAS = np.array([5.0, 5.0, 10.0, 0.5, 0.5, 4.0])


def test_yaw_is_compared_the_short_way_around():
    turned = MEAN + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 10.0 - 360.0])
    assert differences(np.stack([turned, MEAN]), MEAN)[:, 5] == pytest.approx([10.0, 0.0])


def test_many_steps_are_shortened_each_by_itself():
    steps = np.array([[60.0, 0, 0, 0, 0, 0], [0, 1.0, 0, 0, 0.5, 0], np.zeros(6)])
    np.testing.assert_allclose(shortened(steps), steps * [[0.1], [1.0], [1.0]])


def test_without_a_range_it_is_the_gaussian():
    prior = Prior(MEAN, SIGMAS)
    away = np.random.default_rng(0).normal(size=(5, 6)) * SIGMAS
    expected = -0.5 * np.einsum("ni,ij,nj->n", away, prior.information(), away)
    np.testing.assert_allclose(prior.log_density(MEAN + away), expected)


@pytest.mark.parametrize("number", range(6))
def test_ends_of_a_range_cost_only_beyond_it(number):
    half_widths = 2.0 * SIGMAS
    plain, ranged = Prior(MEAN, SIGMAS), Prior(MEAN, SIGMAS, half_widths)
    step = np.eye(6)[number] * half_widths
    within, beyond = MEAN + 0.99 * step, MEAN + 1.5 * step
    assert ranged.log_density(within[None]) == pytest.approx(plain.log_density(within[None]))
    assert ranged.log_density(beyond[None])[0] < plain.log_density(beyond[None])[0] - 0.1


def test_a_likelihood_times_a_prior_peaks_between_the_two():
    information, gradient = np.diag([4.0, 1.0]), np.array([-8.0, 0.0])
    posterior = Quadratic(information, gradient, -3.0).times_prior(np.array([4.0, 1.0]), np.array([0.0, 2.0]))
    # Likelihood: 2 and 0 away; prior: 0 and -2 away, each as sure.
    np.testing.assert_allclose(posterior.step(), [1.0, -1.0])
    assert posterior.log_density == pytest.approx(-3.0 - 0.5 * 2.0**2)
