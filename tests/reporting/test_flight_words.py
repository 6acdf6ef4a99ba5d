"""What flights say, in words, and their page in a real browser; ellipses against their covariances."""

import re

import cv2
import numpy as np
import pytest

from lodbench.geometry import EulerAngles, Pose
from lodbench.harness.photo.many import FlightAnswer
from lodbench.photos.map_frame import GeoPose, survey_row
from lodbench.reporting.flight_words import (
    MAX_PICTURES,
    chosen_for_pictures,
    constant_rows,
    constants_in_words,
    flight_page,
    map_in_words,
    photo_on_page,
)
from lodbench.reporting.maps import Marked, Spot, draw_map
from lodbench.reporting.page import Picture
from tests.reporting.browser import PHONE, fits, opened


def constant(value, sigma, unit="m", determined=True):
    return {"value": value, "sigma": sigma, "unit": unit, "determined": determined}


def test_constants_are_reported_with_as_many_digits_as_they_have():
    found = constants_in_words(
        {
            "pitch": constant(-0.8049, 0.096, "deg"),
            "focal length": constant(0.0203, 0.002, "share"),
            "roll": constant(-0.001, 0.09, "deg"),
            "yaw": constant(3.0, 4.0, "deg", determined=False),
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
            "principal point to the right": constant(-0.002, 0.002, "share", determined=False),
            "masks too large by": constant(0.0, 0.5, "px", determined=False),
        }
    )
    # Without masks there are no edges of masks.
    assert rows == [
        ("positions, to the east", "+1 m +-3", True, "yes: not significant"),
        ("positions, to the north", "+6 m +-3", True, "yes"),
        ("principal point to the right", "-", False, "no: these photos leave +-0.2 % open"),
    ]


def test_poses_that_a_file_gives_are_not_called_metadata():
    reported = constants_in_words(
        {"height": constant(-31.92, 0.4), "pitch": constant(-0.8, 0.1, "deg")}, "poses"
    )
    assert reported == [
        "heights in the given poses are 31.9 m too high +-0.4, as if measured from the ellipsoid or the "
        "take-off point",
        "corrections to the given poses: gimbal pitch -0.8 deg +-0.1",
    ]


COUNT = 5
CONSTANTS = {
    "height": {"value": -31.9, "sigma": 0.4, "unit": "m", "determined": True},
    "pitch": {"value": -0.8, "sigma": 0.1, "unit": "deg", "determined": True},
    "focal length": {"value": 0.0, "sigma": 0.01, "unit": "share", "determined": False},
}


def page(place=None, **changed):
    dot = cv2.imencode(".png", np.zeros((60, 80, 3), np.uint8))[1].tobytes()
    photos, pictures = [], []
    for k in range(COUNT):
        estimate = Pose.from_euler(EulerAngles(30.0, 0.0, 10.0 * k), (30.0 * k, 5.0 * k, 100.0))
        prior, spread = estimate.shifted((4.0, 3.0, 0.0)), np.diag([0.04, 0.01, 0.09, 0.1, 0.1, 0.1])
        poses = prior, estimate, None
        trust = "do not trust" if k == 3 else "good"
        photos.append(
            photo_on_page(f"p{k}.jpg", poses, spread, 0.99, 0.8, trust, survey_row(estimate, place, spread))
        )
        pictures.append(Picture(dot, "png", f"p{k}.jpg: caption", "", f"p{k}.jpg"))
    findings = {
        "constants": CONSTANTS,
        "buildings": [{"id": "B<1>", "higher_m": -2.4, "sigma_m": 0.3, "photos": 4, "doubt": True}],
        "lost": ["p3.jpg"],
        "reasons": {"p3.jpg": "far from the others"},
    }
    values = {
        "title": "Flight 1", "lines": ["5 photos"], "findings": findings, "photos": photos,
        "pictures": pictures, "left_out": [("other.jpg", "9.0 km outside the city model")],
        "city": None, "marked": [Marked("B<1>", [np.array([(0, 0), (20, 0), (20, 9), (0, 0)], float)])],
    }  # fmt: skip
    return flight_page(**{**values, **changed})


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_photos_are_turned_by_the_slider_their_rows_and_the_map(tmp_path, scheme):
    (tmp_path / "flight.html").write_text(page())
    with opened(tmp_path / "flight.html", PHONE, scheme) as (here, complaints):
        assert fits(here)
        words = here.inner_text("main")
        for said in (
            "Heights in the metadata are 31.9 m too high +-0.4, as if measured from the ellipsoid or the",
            "5 photos placed: 4 good, 1 not to be trusted; 1 from the other photos alone; 1 left out",
            "no: these photos leave +-1 % open",
            "B<1>",
            "do not trust, from the others alone: far from the others",
            "2.4 m +-0.3 lower than in the map",
            "other.jpg: 9.0 km outside the city model",
        ):
            assert said in words
        shown = ".slides figure:not([hidden]) figcaption"
        assert here.locator(shown).all_inner_texts() == ["p0.jpg: caption"]
        here.locator(".slides .previous").click()
        assert here.locator(shown).all_inner_texts() == ["p4.jpg: caption"]
        here.locator(".slides input[type=range]").fill("2")
        assert here.locator(shown).all_inner_texts() == ["p2.jpg: caption"]
        here.locator("tr[data-key='p1.jpg']").click()
        assert here.locator(shown).all_inner_texts() == ["p1.jpg: caption"]
        assert here.locator("g.current").get_attribute("data-key") == "p1.jpg"
        assert here.locator(".map .ellipse").count() == COUNT
        assert complaints == []


def test_photos_have_coordinates_and_angles_in_the_table():
    local = page()
    assert ">easting m<" in local
    assert ">latitude<" not in local
    row = local.split('data-key="p2.jpg" tabindex')[1].split("</tr>")[0]
    assert re.findall(r">(-?[\d.]+)</td>", row)[:6] == "60.00 10.00 100.00 340.00 -60.00 0.00".split()
    earth = page(place=GeoPose(51.0261598, 5.8765601, 100.0, 12.5, -60.0, 0.25))
    assert ">latitude<" in earth
    assert ">easting m<" not in earth
    row = earth.split('data-key="p2.jpg" tabindex')[1].split("</tr>")[0]
    cells = ["51.0261598", "5.8765601", "100.00", "12.50", "-60.00", "0.25"]
    assert re.findall(r">(-?[\d.]+)</td>", row)[:6] == cells


def test_heights_that_photos_do_not_tell_are_not_said_to_be_off():
    silent = {"value": -9.2, "sigma": 16.0, "unit": "m", "determined": False}
    constants = {"height": silent, "east": silent}
    words = page(findings={"constants": constants})
    assert "Heights are not determined by these photos." in words
    assert "too high" not in words


def test_heights_of_poses_from_a_file_are_not_called_metadata():
    words = page(source="poses")
    assert "Heights in the given poses are 31.9 m too high +-0.4" in words
    assert "metadata" not in words
    answer = FlightAnswer("flight 1", (), (), {"constants": CONSTANTS}, "poses")
    assert answer.sentences()[0].startswith("heights in the given poses are 31.9 m too high")


def test_an_ellipse_has_the_axes_of_the_covariance():
    turn = np.radians(30.0)
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    spread = axes @ np.diag([400.0, 100.0]) @ axes.T  # 20 m along 30 degrees from east, 10 m across
    html = draw_map([Spot("a", None, np.zeros(2), None, "", spread)], None, None)
    numbers = re.search(r'class="ellipse" d="M([-\d. ]+)A([\d.]+) ([\d.]+) ([-\d.]+) 1 0 ([-\d. ]+)A', html)
    assert numbers is not None
    assert (float(numbers[2]), float(numbers[3])) == (40.0, 20.0)
    (x, y), (u, v) = (tuple(map(float, numbers[k].split())) for k in (1, 5))
    # North is up in the map, so y counts downwards.
    angle = np.degrees(np.arctan2(-(y - v), x - u)) % 180.0
    assert angle == pytest.approx(30.0, abs=0.1)
    assert (-float(numbers[4])) % 180.0 == pytest.approx(30.0, abs=0.1)


def test_of_many_photos_some_are_pictured_from_first_to_last():
    keys = [str(k) for k in range(1000)]
    chosen = chosen_for_pictures(keys)
    assert len(chosen) == MAX_PICTURES
    assert (chosen[0], chosen[-1]) == ("0", "999")
    assert chosen_for_pictures(keys[:7]) == keys[:7]


def test_what_photos_cannot_tell_is_said():
    constants = {"pitch": {"value": -0.8, "sigma": 0.1, "unit": "deg", "determined": True}}
    notes = ["focal length and height <cannot> be told apart"]
    reported = page(findings={"constants": constants, "notes": notes})
    assert "<p>Focal length and height &lt;cannot&gt; be told apart.</p>" in reported


class Halves:
    """Imagery whose northern half is red and whose southern half is not there."""

    name = "dop <1>.tif"

    def within(self, low, high):
        assert (high > low).all()
        pixels = np.zeros((40, 60, 4), np.uint8)
        pixels[:20] = 0, 0, 255, 255
        return pixels


@pytest.mark.slow
def test_imagery_lies_under_the_map_and_can_be_taken_away(tmp_path):
    (tmp_path / "flight.html").write_text(page(imagery=Halves(), view="../found 3d.html"))
    with opened(tmp_path / "flight.html") as (here, complaints):
        picture = here.locator(".map image")
        box, frame = picture.bounding_box(), here.locator(".map svg").bounding_box()
        assert box is not None
        assert box["x"] + box["width"] / 2 == pytest.approx(frame["x"] + frame["width"] / 2, abs=2)
        # Above its middle the page is red there, below it is not.
        shot = cv2.imdecode(np.frombuffer(here.screenshot(clip=box), np.uint8), cv2.IMREAD_COLOR)
        rows = [len(shot) // 4, 3 * len(shot) // 4]
        north, south = (np.median(shot[row], axis=0) for row in rows)
        assert north[2] > 200 > 60 > north[0]
        assert south[0] > 200
        assert "dop <1>.tif" in here.inner_text(".legend")
        here.locator("input.imagery").uncheck()
        assert not picture.is_visible()
        assert here.locator(".legend a").get_attribute("href") == "../found%203d.html"
        assert complaints == []


@pytest.mark.slow
def test_a_photo_is_shown_beside_the_next(tmp_path):
    (tmp_path / "flight.html").write_text(page())
    with opened(tmp_path / "flight.html") as (here, complaints):
        shown = ".slides figure:not([hidden])"
        here.locator("input.twin").check()
        assert [text.split(":")[0] for text in here.locator(shown).all_inner_texts()] == ["p0.jpg", "p1.jpg"]
        left, right = (here.locator(shown).nth(k).bounding_box() for k in (0, 1))
        assert left["y"] == right["y"]
        assert right["x"] >= left["x"] + left["width"]
        here.locator(".slides .next").click()
        assert [text.split(":")[0] for text in here.locator(shown).all_inner_texts()] == ["p1.jpg", "p2.jpg"]
        here.locator("tr[data-key='p4.jpg']").click()
        assert [text.split(":")[0] for text in here.locator(shown).all_inner_texts()] == ["p4.jpg"]
        assert here.locator(".slides input[type=range]").input_value() == "4"
        here.locator("input.twin").uncheck()
        assert here.locator(shown).count() == 1
        assert complaints == []
