"""Rough poses of photos by their names; `lodbench localize` from Python."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lodbench
from lodbench.cli import main
from lodbench.datasets.pose_text import format_pose
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.angles import rotation_from_dji
from tests.cli.photo_case import localize, make_case
from tests.cli.test_localize_flights import flight  # noqa: F401 - a fixture
from tests.photos.dji_photo import write_photo
from tests.town import CAMERA, box_obj

LENS = "PINHOLE 64 48 60 60 32 24"
# One looks level as a drone's does, one hangs turned about its axis as a kite's; each has its own place.
POSES = {
    "a.jpg": Pose.from_center(rotation_from_dji(40.0, -50.0, 0.0), (-30.0, -40.0, 60.0)),
    "b.jpg": Pose.from_center(rotation_from_dji(173.8, -63.25, -120.6), (5.0, 44.0, 80.0)),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    for number, name in enumerate(POSES):
        pixels = np.random.default_rng(number).integers(0, 255, (48, 64, 3), np.uint8)
        Image.fromarray(pixels).save(tmp_path / "photos" / name)
    (tmp_path / "city.obj").write_text(box_obj())
    (tmp_path / "rough.txt").write_text("".join(f"{format_pose(*each)}\n" for each in POSES.items()))
    return tmp_path


def localized(folder: Path, *words: str, photos: str = "photos") -> int:
    own = ("localize", str(folder / photos), "--city", str(folder / "city.obj"), "--method", "prior_only")
    return main([*own, "--out", str(folder / "out"), *words])


def start(folder: Path) -> tuple[str, ...]:
    return ("--start", str(folder / "rough.txt"), "--camera", LENS)


@pytest.mark.parametrize("each", [(), ("--each-alone",)])
def test_each_photo_begins_at_its_own_pose(capsys, folder, each):
    assert localized(folder, *start(folder), *each) == 0
    with (folder / "out" / "localized.csv").open() as stream:
        rows = {Path(row["photo"]).name: row for row in csv.DictReader(stream)}
    for name, pose in POSES.items():
        east, north, up = pose.rotation[2]
        values = [float(rows[name][key]) for key in ("easting_m", "northing_m", "height_m")]
        assert values == pytest.approx(pose.center, abs=1e-3)
        assert float(rows[name]["heading_deg"]) == pytest.approx(
            math.degrees(math.atan2(east, north)), abs=1e-3
        )
        assert float(rows[name]["pitch_deg"]) == pytest.approx(math.degrees(math.asin(up)), abs=1e-3)
    assert float(rows["b.jpg"]["roll_deg"]) == pytest.approx(-120.6, abs=1e-3)
    table = capsys.readouterr().out
    assert "easting m  northing m" in table
    assert "latitude" not in table


def test_one_photo_says_where_it_looks_from_grid_north(capsys, folder):
    assert localized(folder, *start(folder), photos="photos/b.jpg") == 0
    told = capsys.readouterr().out
    assert "heading    173.80 deg clockwise from grid north, pitch -63.25, roll -120.60\n" in told
    # What is printed, given back, is the same pose.
    place = "--center 5 44 80 --heading 173.80 --pitch -63.25 --roll -120.60 --json --camera".split()
    assert localized(folder, *place, LENS, photos="photos/b.jpg") == 0
    again = json.loads(capsys.readouterr().out)["pose"]
    np.testing.assert_allclose(again["quat_wxyz"], POSES["b.jpg"].quat_wxyz, atol=1e-9)


def test_a_photo_that_the_file_lacks_fails_alone(capsys, folder):
    (folder / "rough.txt").write_text(format_pose("a.jpg", POSES["a.jpg"]) + "\n")
    assert localized(folder, *start(folder)) == 3
    told = capsys.readouterr().out
    assert f"b.jpg: {folder / 'rough.txt'} has no pose of b.jpg" in told
    assert "hint: --start needs one of each photo" in told
    assert "2 photos: 1 of unknown trust, 1 failed" in told


def test_what_fails_alike_is_one_line_and_a_hint_that_fits_a_folder(capsys, folder):
    assert localized(folder) == 1
    told = capsys.readouterr().out
    lines = [line for line in told.splitlines() if line.startswith(("failed:", "hint:"))]
    assert len(lines) == 2
    photos = folder / "photos"
    assert lines[0].startswith(
        f"failed: 2 photos ({photos / 'a.jpg'}, {photos / 'b.jpg'}): the photo does not"
    )
    assert "--start FILE with a rough pose of each photo by its name and --camera" in lines[1]
    assert "--lat" not in told
    # In the table each has its own.
    with (folder / "out" / "localized.csv").open() as stream:
        assert [row["failure"][:18] for row in csv.DictReader(stream)] == [
            "a.jpg does not say",
            "b.jpg does not say",
        ]


def test_a_place_that_the_city_has_no_use_for_hints_at_poses_too(capsys, folder):
    words = ["--height", "60", "--heading", "40", "--pitch", "-50", "--camera", LENS]
    photo = Image.open(folder / "photos" / "a.jpg")
    exif = photo.getexif()
    exif.get_ifd(0x8825).update({1: "N", 2: (51.0, 1.0, 2.0), 3: "E", 4: (5.0, 1.0, 2.0)})
    photo.save(folder / "photos" / "a.jpg", exif=exif)
    (folder / "photos" / "b.jpg").unlink()
    assert localized(folder, *words) == 1
    told = capsys.readouterr().out
    assert "names no reference system" in told
    assert (
        "hint: Name it with --crs, or give --start FILE with a rough pose of each photo by its name." in told
    )


def test_a_file_of_other_photos_or_none_is_one_line(capsys, folder):
    (folder / "rough.txt").write_text(format_pose("other.jpg", POSES["a.jpg"]) + "\n")
    assert localized(folder, *start(folder)) == 2
    told = capsys.readouterr().err
    assert "has none of these photos" in told
    assert "Its images are called other.jpg." in told
    assert localized(folder, "--start", "nowhere.txt") == 2
    assert "nowhere.txt does not exist" in capsys.readouterr().err


def test_from_python(folder):
    from lodbench import localize_photo

    found = localize_photo(
        folder / "photos" / "b.jpg",
        folder / "city.obj",
        start=folder / "rough.txt",
        camera=LENS,
        method="prior_only",
        out=folder / "out",
    )
    np.testing.assert_allclose(found.pose.center, POSES["b.jpg"].center, atol=1e-6)


def test_an_unreliable_pose_of_a_photo_without_a_roll_hints_at_it(capsys, folder):
    """By a mask that no building fits; a roll that is given, or comes with a pose, is not asked for."""
    specks = np.random.default_rng(1).uniform(size=(48, 64)) < 0.1
    Image.fromarray((255 * specks).astype(np.uint8)).save(folder / "mask.png")
    mask = ("--method", "lodlocv2", "--method-option", "steps=1", "--mask", str(folder / "mask.png"))
    place = (*"--center 5 44 80 --heading 173.80 --pitch -63.25 --camera".split(), LENS)
    said = {}
    for name, words in {"none": place, "given": (*place, "--roll", "0"), "file": start(folder)}.items():
        assert localized(folder, *words, *mask, photos="photos/b.jpg") == 3
        said[name] = capsys.readouterr().out
    assert "--height, --heading or --roll (0 was assumed) or a wider --prior-range" in said["none"]
    assert "--roll" not in said["given"]
    assert "--roll" not in said["file"]
    assert f"give a better pose in {folder / 'rough.txt'} or a wider --prior-range" in said["file"]


def test_photos_of_one_name_are_told_apart_by_whole_paths(folder):
    for number, name in enumerate(POSES):
        (folder / "photos" / str(number)).mkdir()
        (folder / "photos" / name).rename(folder / "photos" / str(number) / "same.jpg")
    head, *rows = "name,x,y,z,heading,pitch\n,-30,-40,60,40,-50\n,5,44,80,170,-60\n".splitlines()
    paths = [folder / "photos" / str(number) / "same.jpg" for number in range(2)]
    lines = [head, *(f"{path}{row}" for path, row in zip(paths, rows, strict=True))]
    (folder / "rough.txt").write_text("\n".join(lines))
    assert localized(folder, *start(folder)) == 0
    with (folder / "out" / "localized.csv").open() as stream:
        found = {row["photo"]: float(row["easting_m"]) for row in csv.DictReader(stream)}
    assert found == {str(paths[0]): -30.0, str(paths[1]): 5.0}


def test_a_plain_table_and_lodbench_s_own_begin_at_the_same_poses(capsys, folder):
    (folder / "rough.txt").write_text(
        "photo;x;y;altitude (m);yaw;pitch;roll\n"
        "a.jpg;-30;-40;60;40;-50;0\n"
        "b.jpg;5;44;80;173.8;-63.25;-120.6\n"
    )  # fmt: skip
    assert localized(folder, *start(folder)) == 0
    found = (folder / "out" / "localized.csv").read_text()
    capsys.readouterr()
    again = (
        "--start",
        str(folder / "out" / "localized.csv"),
        "--camera",
        LENS,
        "--out",
        str(folder / "again"),
    )
    assert localized(folder, *again) == 0
    assert (folder / "again" / "localized.csv").read_text() == found
    with (folder / "out" / "localized.csv").open() as stream:
        rows = {Path(row["photo"]).name: row for row in csv.DictReader(stream)}
    for name, pose in POSES.items():
        values = [float(rows[name][key]) for key in ("easting_m", "northing_m", "height_m")]
        assert values == pytest.approx(pose.center, abs=1e-3)
    assert [float(rows["b.jpg"][key]) for key in ("heading_deg", "pitch_deg", "roll_deg")] == pytest.approx(
        [173.8, -63.25, -120.6], abs=1e-3
    )


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
    assert [answer.localized.to_json()["pose"] for answer in answers.photos] == [
        each["pose"] for each in expected
    ]
    assert [answer.localized.probability for answer in answers.photos] == [
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
