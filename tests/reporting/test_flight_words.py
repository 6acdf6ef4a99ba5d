"""What flights say, in words."""

from __future__ import annotations

import pytest

from lodbench.reporting.flight_words import buildings_in_words, constants_in_words


def constant(value, sigma, unit="m", told=True):
    return {"value": value, "sigma": sigma, "unit": unit, "told": told}


def test_constants_are_told_with_as_many_digits_as_they_have():
    found = constants_in_words(
        {
            "pitch": constant(-0.8049, 0.096, "deg"),
            "focal length": constant(0.0203, 0.002, "share"),
            "roll": constant(-0.001, 0.09, "deg"),
            "yaw": constant(3.0, 4.0, "deg", told=False),
        }
    )
    assert found == [
        "to be added to what was stated: gimbal pitch -0.80 deg +-0.10; gimbal roll +0.00 deg +-0.09; "
        "focal length +2.0 % +-0.2",
        "not told by these photos, and left as stated: heading, counter-clockwise",
    ]


@pytest.mark.parametrize(
    ("value", "sigma", "said"),
    [
        (-31.92, 0.4, "stated 31.9 m too high +-0.4: ellipsoid or take-off?"),
        (61.0, 0.4, "stated 61.0 m too low +-0.4: take-off?"),
        (-2.0, 0.4, "stated 2.0 m too high +-0.4"),
        (12.0, 5.0, "stated 12 m too low +-5"),
    ],
)
def test_heights_far_off_are_of_another_zero(value, sigma, said):
    (line,) = constants_in_words({"height": constant(value, sigma)})
    assert said in line
    assert ("?" in line) == ("?" in said)


def test_the_surest_building_in_doubt_comes_first():
    one = {"id": "a", "higher_m": -2.0, "sigma_m": 0.9, "photos": 4, "doubt": True}
    two = {"id": "b", "higher_m": 1.5, "sigma_m": 0.2, "photos": 9, "doubt": True}
    sure = {"id": "c", "higher_m": 0.1, "sigma_m": 0.2, "photos": 9, "doubt": False}
    head, first, second = buildings_in_words([one, two, sure])
    assert head.startswith("2 of 3 buildings")
    assert first == "- b: 1.5 m +-0.2 higher than in the map, by 9 photos"
    assert second.startswith("- a: 2.0 m +-0.9 lower")
    assert buildings_in_words([sure]) == []
    assert buildings_in_words([one, two], most=1)[-1] == "- and 1 more"
