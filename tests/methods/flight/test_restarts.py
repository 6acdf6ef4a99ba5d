"""Other starts of a flight: which photos start again, and what their ends are compared with."""

import numpy as np
import pytest

from lodbench.methods.flight import FlightParams, method
from lodbench.methods.flight.aligning import align
from lodbench.methods.flight.starts import ends_of, restarted
from tests.methods.flight.test_method import flight, localize


def test_photos_from_all_over_a_long_flight_start_again():
    spread, middle = restarted(500, tied=False), restarted(500, tied=True)
    assert len(spread) == len(middle) == 40
    assert (spread[0], spread[-1]) == (0, 499)
    assert set(np.diff(middle)) == {1}
    assert middle[0] == 230
    for tied in (False, True):
        np.testing.assert_array_equal(restarted(7, tied), np.arange(7))


def test_ends_that_fit_worse_are_left_out():
    here, there = np.zeros((3, 6)), np.full((3, 6), 0.5)
    kept = ends_of([(here, np.zeros(11), 0.9), (there, np.ones(11), 0.89)])
    assert kept.middle[0] == pytest.approx(np.full(6, 0.25))
    alone = ends_of([(here, np.zeros(11), 0.9), (there, np.ones(11), 0.87)])
    assert alone.middle[0] == pytest.approx(np.zeros(6))
    assert not alone.covariances[0].any()


@pytest.mark.slow
def test_what_some_photos_of_a_long_flight_err_by_moves_not_all_of_it(city_map, monkeypatch):
    queries, _ = flight(city_map, count=6, focal=1.0)

    def some_end_aside(these, *rest):
        found = align(these, *rest)
        if len(these) < len(queries):
            found.state.vectors = found.state.vectors + np.array([0.7, -0.4, 0.0, 0.0, 0.0, 0.0])
        return found

    def places(restarts):
        params = FlightParams(restarts=restarts, steps=3)
        return np.array([found.pose.center for found in localize(queries, city_map, params).estimates])

    alone = places(0)
    monkeypatch.setattr("lodbench.methods.flight.starts._MOST_PHOTOS", 3)
    undisturbed = places(1)
    monkeypatch.setattr(method, "align", some_end_aside)
    assert places(1) == pytest.approx(undisturbed, abs=1e-9)
    assert np.abs(undisturbed - alone).max() < 0.1
