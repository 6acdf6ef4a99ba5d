import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lodbench.estimation.evolution import maximize, maximize_abreast
from lodbench.estimation.probability import Gaussian


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
