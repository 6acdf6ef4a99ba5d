"""Heights of buildings: what the map, outlines and pixels say, together."""

import numpy as np
import pytest

from lodbench.methods.flight import building_heights as module
from lodbench.methods.flight.building_heights import BuildingHeight, _Outlines, building_heights
from lodbench.methods.flight.params import FlightParams
from lodbench.methods.flight.roof_sweep import HEIGHTS_M, RoofCurve

# Roofs of others, which pixels find as the map has them.
OTHERS = {row: RoofCurve(-0.5 * (HEIGHTS_M / 0.3) ** 2, 8) for row in range(1, 6)}
# How far heights are known before outlines are looked at, with two parts of a roof and errors as told.
BEFOREHAND_M = 1.73


def told(monkeypatch, outlines=None, nats=None, rise_m=20.0) -> BuildingHeight | None:
    by_outlines = {} if outlines is None else {0: _Outlines(*outlines, beforehand_m=BEFOREHAND_M)}
    monkeypatch.setattr(module, "_by_outlines", lambda aligned, params: by_outlines)
    rises = np.array([rise_m, *[20.0] * 5])
    monkeypatch.setattr(module, "floors_and_rises", lambda scene: (np.zeros(6), rises))
    curves = OTHERS if nats is None else {**OTHERS, 0: RoofCurve(nats, 8)}
    return building_heights(None, curves, None, FlightParams()).get(0)


def peaks(*heights_m: float, nats: float = 8.0):
    away = np.min([np.abs(HEIGHTS_M - height) for height in heights_m], axis=0)
    return -np.minimum(0.5 * (away / 0.3) ** 2, nats)


@pytest.mark.parametrize(
    ("higher_m", "sigma_m", "rise_m", "is_in_doubt"),
    [
        (2.5, 0.5, 3.0, True),
        (-2.5, 0.5, 8.0, True),
        (1.5, 1.0, 8.0, False),  # too unsure
        (0.9, 0.1, 8.0, False),  # too little
        (-2.5, 0.5, 2.9, False),  # a shed that masks do not show: it may be gone, but is no lower
        (30.0, 1.0, 8.0, True),  # a tower that pixels were not looked up for
    ],
)
def test_outlines_alone_contradict_the_map(monkeypatch, higher_m, sigma_m, rise_m, is_in_doubt):
    height = told(monkeypatch, (higher_m, sigma_m), rise_m=rise_m)
    assert height.is_in_doubt is is_in_doubt
    assert height.photos == 0
    if is_in_doubt:
        assert height.higher_m == pytest.approx(higher_m, abs=0.3)


def test_outlines_choose_between_two_heights_that_pixels_find_alike(monkeypatch):
    height = told(monkeypatch, (2.5, 1.0), peaks(3.0, -3.0))
    assert height.higher_m == pytest.approx(3.0, abs=0.2)
    assert height.sigma_m < 0.8
    assert height.is_in_doubt
    assert height.photos == 8
    # By itself neither is told.
    assert told(monkeypatch, None, peaks(3.0, -3.0)) is None


def test_most_heights_of_a_map_are_right(monkeypatch):
    # Two heights that explain photos alike, one of them the map's.
    assert not told(monkeypatch, None, peaks(0.0, -3.0)).is_in_doubt
    assert told(monkeypatch, None, peaks(-3.0)).is_in_doubt
    # What pixels hardly tell stays as outlines have it.
    assert not told(monkeypatch, (0.0, 0.7), peaks(-3.0, nats=2.0)).is_in_doubt


def test_what_was_known_beforehand_counts_once(monkeypatch):
    # Outlines that halve what was open place a roof twice as high as the joint problem does.
    height = told(monkeypatch, (1.6, BEFOREHAND_M / np.sqrt(2.0)), peaks(3.2, nats=2.5))
    assert height.higher_m == pytest.approx(3.2, abs=0.2)
    assert height.is_in_doubt
    # Those that tell nothing leave it to pixels.
    for outlines in (None, (0.0, BEFOREHAND_M), (0.1, BEFOREHAND_M + 0.1)):
        assert told(monkeypatch, outlines, peaks(3.2)).higher_m == pytest.approx(3.2, abs=0.1)


def test_what_outlines_place_beyond_the_heights_that_pixels_look_at_is_theirs(monkeypatch):
    height = told(monkeypatch, (10.0, 0.5), peaks(0.0))
    assert (height.higher_m, height.photos) == (pytest.approx(10.0, abs=0.1), 0)


def test_heights_are_against_what_all_roofs_are_wrong_about(monkeypatch):
    monkeypatch.setattr(module, "_common", lambda curves: -3.0)
    assert told(monkeypatch, None, peaks(-3.0)).higher_m == pytest.approx(0.0, abs=0.05)
    assert told(monkeypatch, None, peaks(-1.0)).higher_m == pytest.approx(2.0, abs=0.15)
