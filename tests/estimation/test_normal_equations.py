"""Errors told too large by an unknown factor: the factor is found where residuals tell it, and only there."""

import numpy as np
import pytest

from lodbench.estimation.normal_equations import ErrorGroup, NormalEquations

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
