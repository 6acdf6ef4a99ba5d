"""`lodbench.localize_photo` and `localize_flight` return what the command says, and write its files."""

import json

import numpy as np
import pytest

import lodbench
from lodbench.cli import main
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import EulerAngles, Pose
from tests.cli.photo_case import localize, make_case
from tests.cli.test_localize_flights import flight  # noqa: F401 - a fixture
from tests.photos.dji_photo import write_photo
from tests.town import CAMERA, box_obj


@pytest.mark.slow
def test_a_photo_is_localised_as_by_the_command(capsys, tmp_path, shared_data):
    case = make_case(tmp_path, shared_data, "nrw", distorted=True)
    height = ("--height-offset", "-1.5e0", "--method", "contour_alignment")
    expected = localize(capsys, case, tmp_path / "out", "--mask", str(case.mask), *height)
    found = lodbench.localize_photo(
        case.photo,
        case.city,
        mask=case.mask,
        out=tmp_path / "again",
        height_offset=-1.5,
        method="contour_alignment",
    )
    again = json.loads(json.dumps(found.to_json()))
    for values in (expected, again):
        for name in ("overlay", "geojson"):
            del values[name]
    assert again == expected
    assert found.trust == "doubtful"
    assert capsys.readouterr().out == ""
    assert {path.name for path in (tmp_path / "again").iterdir()} == {
        path.name for path in (tmp_path / "out").iterdir()
    }


@pytest.mark.slow
def test_a_flight_is_localised_as_by_the_command(capsys, tmp_path, flight):  # noqa: F811
    words = ["localize", str(flight.photos), "--city", str(flight.city), "--masks", str(flight.masks)]
    assert main([*words, "--out", str(tmp_path / "out"), "--json"]) == 0
    expected = json.loads(capsys.readouterr().out)
    answers = lodbench.localize_flight(flight.photos, flight.city, masks=flight.masks, out=tmp_path / "again")
    assert [answer.found.to_json()["pose"] for answer in answers.photos] == [
        each["pose"] for each in expected
    ]
    assert [answer.found.probability for answer in answers.photos] == [
        each["probability"] for each in expected
    ]
    assert answers.table.read_text() == (tmp_path / "out" / "localized.csv").read_text()
    assert answers.flights[0].name == "flight 1"


@pytest.fixture
def photo(tmp_path):
    """A photo without metadata over a box."""
    (tmp_path / "city.obj").write_text(box_obj([(-20, -20, 20, 20, 0, 15)]))
    return write_photo(tmp_path / "a.jpg", np.full((CAMERA.height, CAMERA.width), 90, np.uint8))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"takeof": 3}, "no option takeof"),
        ({"json": True}, "no option json"),
        ({"method": "nothing"}, "nothing"),
        ({"seed": "x"}, "seed"),
        ({"center": (1, 2)}, "center"),
        ({"masks": "m"}, "masks is for several"),
        ({"camera": "PINHOLE 3 3"}, "camera: too few values"),
    ],
)
def test_a_wrong_option_is_one_line(photo, options, message):
    with pytest.raises(ConfigError, match=message) as caught:
        lodbench.localize_photo(photo, photo.with_name("city.obj"), **options)
    assert caught.value.hint


def test_what_a_photo_lacks_is_asked_for_by_arguments(photo):
    with pytest.raises(DatasetError) as caught:
        lodbench.localize_photo(photo, photo.with_name("city.obj"))
    assert "center=(EAST, NORTH, UP)" in caught.value.hint
    assert "heading and pitch (" in caught.value.hint
    assert "--" not in f"{caught.value} {caught.value.hint}"


def test_a_folder_is_a_flight_and_a_photo_is_none(photo):
    city = photo.with_name("city.obj")
    with pytest.raises(DatasetError, match="does not exist"):
        lodbench.localize_flight(photo.with_name("nowhere"), city)
    with pytest.raises(ConfigError, match="is one photo"):
        lodbench.localize_flight([photo], city)
    with pytest.raises(ConfigError, match="is a folder"):
        lodbench.localize_photo(photo.parent, city)


def test_options_of_several_words_and_of_settings(photo, tmp_path):
    """A camera at (0, 0, 100) that looks down on a box: all of it by options."""
    found = lodbench.localize_photo(
        str(photo),
        photo.with_name("city.obj"),
        center=(0.5, -1.5e-1, 100),
        heading=0,
        pitch=-90,
        roll=0.0,
        camera="PINHOLE 320 240 230 228 161 118.5",
        method="prior_only",
        out=tmp_path / "out",
    )
    truth = Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), (0.5, -0.15, 100.0))
    assert found.pose.center == pytest.approx(truth.center)
    assert found.prior.rotation == pytest.approx(truth.rotation)
