"""Priors of state vectors, and what products with them leave open."""

import numpy as np
import pytest

from lodbench.estimation.normal_equations import Quadratic
from lodbench.estimation.prior import Prior
from lodbench.estimation.state_vector import differences, shortened

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
