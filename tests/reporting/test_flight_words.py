"""What flights say, in words."""

import pytest

from lodbench.reporting.flight_words import constant_rows, constants_in_words, map_in_words


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
        "corrections to the drone's metadata: gimbal pitch -0.80 deg +-0.10; gimbal roll +0.00 deg +-0.09; "
        "focal length +2.0 % +-0.2",
        "not determined by these photos: heading, counter-clockwise",
    ]


@pytest.mark.parametrize(("value", "side"), [(-0.1, "inside"), (0.1, "outside")])
def test_masks_and_map_are_apart_from_the_drone(value, side):
    found = constants_in_words(
        {
            "masks too large by": constant(value, 0.02, "px"),
            "roofs higher than the map": constant(0.5, 0.2),
            "pitch": constant(-0.8, 0.1, "deg"),
        }
    )
    assert found == [
        "corrections to the drone's metadata: gimbal pitch -0.8 deg +-0.1",
        f"masks and map: mask edges 0.10 px +-0.02 too far {side}; roofs relative to the map +0.5 m +-0.2",
    ]


@pytest.mark.parametrize(
    ("value", "sigma", "said"),
    [
        (-31.92, 0.4, "are 31.9 m too high +-0.4, as if measured from the ellipsoid or the take-off point"),
        (61.0, 0.4, "are 61.0 m too low +-0.4, as if measured from the take-off point"),
        (-2.0, 0.4, "are 2.0 m too high +-0.4"),
        (12.0, 5.0, "are 12 m too low +-5"),
    ],
)
def test_heights_far_off_are_of_another_zero(value, sigma, said):
    (line,) = constants_in_words({"height": constant(value, sigma)})
    assert said in line
    assert ("as if" in line) == ("as if" in said)


def test_the_surest_building_in_doubt_comes_first_and_changes_follow():
    one = {"id": "a", "higher_m": -2.0, "sigma_m": 0.9, "photos": 4, "apart_deg": 61.6, "doubt": True}
    two = {"id": "b", "higher_m": 1.5, "sigma_m": 0.2, "photos": 9, "doubt": True}
    sure = {"id": "c", "higher_m": 0.1, "sigma_m": 0.2, "photos": 9, "doubt": False}
    gone = {"kind": "demolished", "id": "d", "probability": 0.97, "photos": ["p1", "p2", "p3", "p4"]}
    lacking = {"kind": "unmapped", "outline": [], "area_m2": 120.0, "photos": ["p5"]}
    lacking |= {"height_m": 8.0, "sigma_m": 0.6, "at_most_m": 12.0}
    findings = {"buildings": [one, two, sure], "changes": [gone, lacking]}
    assert map_in_words(findings) == [
        "3 possible errors of the map, 3 buildings checked:",
        "- b: 1.5 m +-0.2 higher than in the map, from 9 photos",
        "- a: 2.0 m +-0.9 lower than in the map, from 4 photos up to 62 deg apart",
        "- d: probably demolished (97 %), from 4 photos (p1, p2, p3, ...)",
        "1 place with buildings, containers or heaps not in the map, which may hold a part of all:",
        "- not in the map: 120 m2, 8.0 m +-0.6 high, from 1 photo (p5)",
    ]
    assert map_in_words({"buildings": [sure]}) == []
    unknown = {**lacking, "height_m": None, "sigma_m": None}
    (line,) = map_in_words({"changes": [unknown]})[1:]
    assert line == "- not in the map: 120 m2, height not determined, below 12 m, from 1 photo (p5)"
    (line,) = map_in_words({"changes": [{**unknown, "at_most_m": None}]})[1:]
    assert line == "- not in the map: 120 m2, height not determined, from 1 photo (p5)"
    assert map_in_words(findings, most=1)[2] == "- and 2 more"


def test_an_estimate_and_what_it_is_worth_do_not_contradict_each_other():
    rows = constant_rows(
        {
            "east": constant(1.0, 3.0),
            "north": constant(6.5, 3.0),
            "principal point to the right": constant(-0.002, 0.002, "share", told=False),
            "masks too large by": constant(0.0, 0.5, "px", told=False),
        }
    )
    # Without masks there are no edges of masks.
    assert rows == [
        ("positions, to the east", "+1 m +-3", True, "yes: not significant"),
        ("positions, to the north", "+6 m +-3", True, "yes"),
        ("principal point to the right", "-", False, "no: these photos leave +-0.2 % open"),
    ]


def test_poses_that_a_file_gives_are_not_called_metadata():
    told = constants_in_words({"height": constant(-31.92, 0.4), "pitch": constant(-0.8, 0.1, "deg")}, "poses")
    assert told == [
        "heights in the given poses are 31.9 m too high +-0.4, as if measured from the ellipsoid or the "
        "take-off point",
        "corrections to the given poses: gimbal pitch -0.8 deg +-0.1",
    ]
