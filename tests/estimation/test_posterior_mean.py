"""The mean of the posterior, against integrals of densities whose axes are independent."""

import numpy as np
import pytest
import scipy.optimize

from lodbench.estimation.posterior import _root, posterior_mean

X = np.linspace(-8.0, 8.0, 4001)
MODE, COVARIANCE = np.full(6, 0.3), np.diag([4.0, 1.0, 2.0, 0.5, 0.5, 1.0])


def no_prior(poses):
    return np.zeros(len(poses))


class Independent:
    """A density of which each number is independent of the others."""

    def __init__(self, log_density):
        self.log_density = log_density

    def mean(self, vector=MODE, covariance=COVARIANCE):
        """Returns what is found."""
        return posterior_mean(
            lambda poses, share: share * self.log_density(poses).sum(axis=1),
            no_prior,
            vector,
            covariance,
            0.0,
        )

    def means(self):
        """Returns the (6,) means by integrating each axis by itself."""
        logs = self.log_density(np.repeat(X[:, None], 6, axis=1))
        weights = np.exp(logs - logs.max(axis=0))
        return (weights * X[:, None]).sum(axis=0) / weights.sum(axis=0)


def gaussian(vectors):
    return -0.5 * (vectors - np.array([1.0, -0.5, 0.0, 0.6, 0.3, 0.0])) ** 2 / np.diagonal(COVARIANCE)


def bumpy(vectors):
    """A wide hill whose top is a bump far down its side."""
    return -0.5 * vectors**2 + 1.5 * np.exp(-0.5 * ((vectors - 1.2) / 0.1) ** 2)


def one_sided(vectors):
    """Steep below its top at 0, gentle above."""
    return np.where(vectors < 0.0, -2.0 * vectors**2, -0.3 * vectors**2)


@pytest.mark.parametrize("density", [gaussian, bumpy, one_sided])
def test_it_is_the_integral_s(density):
    evidence = Independent(density)
    found = evidence.mean()
    spread = np.sqrt(np.diagonal(COVARIANCE))
    assert (np.abs(found - evidence.means()) < 0.2 * spread).all()


def test_the_mean_of_a_bumpy_hill_is_not_its_top():
    found = Independent(bumpy).mean(np.full(6, 1.2))
    # Six numbers by a thousand draws: how far they are off together.
    assert np.sqrt(np.mean((found - Independent(bumpy).means()) ** 2)) < 0.3
    assert (found < 0.6).all()


def test_a_direction_that_is_held_stays():
    held = np.diag([4.0, 1.0, 2.0, 1e-12, 1e-12, 1.0])
    found = Independent(gaussian).mean(covariance=held)
    np.testing.assert_allclose(found[3:5], MODE[3:5], atol=1e-5)


def test_what_a_share_alone_adds_is_no_pose_s():
    def with_level(poses, share):
        return share * bumpy(poses).sum(axis=1) + 50.0 * share**2

    # Tempered, so that rounds are drawn at different shares.
    found = posterior_mean(with_level, no_prior, MODE, COVARIANCE, 2.8)
    without = posterior_mean(
        lambda poses, share: share * bumpy(poses).sum(axis=1), no_prior, MODE, COVARIANCE, 2.8
    )
    np.testing.assert_allclose(found, without, atol=1e-9)


def test_signs_and_order_of_axes_do_not_matter(monkeypatch):
    once, solve = Independent(bumpy).mean(), np.linalg.eigh

    def otherwise(matrix):
        squares, axes = solve(matrix)
        return squares[::-1], axes[:, ::-1] * np.array([1, -1, 1, -1, -1, 1])

    monkeypatch.setattr(np.linalg, "eigh", otherwise)
    np.testing.assert_allclose(Independent(bumpy).mean(), once, atol=1e-9)


def test_it_draws_the_same_every_time():
    first, second = (Independent(bumpy).mean() for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(("least_m", "expected_m"), [(0.1, 0.3), (0.3, 0.3), (0.8, 0.8)])
def test_sharp_evidence_is_tempered_until_the_place_is_wide_enough(least_m, expected_m):
    """Of a sharp Gaussian likelihood and a wide prior around another place: their weighted mean."""
    seen, before, prior_m = np.array([0.3, 0.0, 0.0]), np.array([2.0, 0.0, 0.0]), 2.0
    sharp_m = 0.3 / np.sqrt(3.0)

    def log_likelihood(poses, share):
        return -0.5 * share * ((poses - seen) ** 2).sum(axis=1) / sharp_m**2

    def log_prior(poses):
        return -0.5 * ((poses - before) ** 2).sum(axis=1) / prior_m**2

    found = posterior_mean(log_likelihood, log_prior, seen, np.eye(3), least_m)
    each_m = expected_m / np.sqrt(3.0)
    share = (each_m**-2 - prior_m**-2) / sharp_m**-2
    expected = seen + (before - seen) * (prior_m**-2 / (share / sharp_m**2 + prior_m**-2))
    np.testing.assert_allclose(found, expected, atol=0.03)


@pytest.mark.parametrize("seed", range(30))
def test_a_root_is_where_scipy_has_it_to_the_bit(seed):
    zero, bend, wave = np.random.default_rng(seed).uniform((-2.9, 0.2, 0.0), (-0.1, 5.0, 0.4))

    def value(place):
        away = zero - place
        return float(np.expm1(bend * away) / bend + wave * np.sin(3.0 * away))

    assert _root(value, -3.0, 0.0, 0.01) == scipy.optimize.brentq(value, -3.0, 0.0, xtol=0.01)
