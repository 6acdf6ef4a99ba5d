"""`lodbench localize --start`: photos that state nothing, in a city without a reference system."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lodbench.cli import main
from lodbench.datasets.pose_text import format_pose
from lodbench.geometry import Pose
from lodbench.geometry.angles import rotation_from_dji
from tests.town import box_obj

CAMERA = "PINHOLE 64 48 60 60 32 24"
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


def localize(folder: Path, *words: str, photos: str = "photos") -> int:
    own = ("localize", str(folder / photos), "--city", str(folder / "city.obj"), "--method", "prior_only")
    return main([*own, "--out", str(folder / "out"), *words])


def start(folder: Path) -> tuple[str, ...]:
    return ("--start", str(folder / "rough.txt"), "--camera", CAMERA)


@pytest.mark.parametrize("each", [(), ("--each-alone",)])
def test_each_photo_begins_at_its_own_pose(capsys, folder, each):
    assert localize(folder, *start(folder), *each) == 0
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
    assert localize(folder, *start(folder), photos="photos/b.jpg") == 0
    told = capsys.readouterr().out
    assert "heading    173.80 deg clockwise from grid north, pitch -63.25, roll -120.60\n" in told
    # What is printed, given back, is the same pose.
    place = "--center 5 44 80 --heading 173.80 --pitch -63.25 --roll -120.60 --json --camera".split()
    assert localize(folder, *place, CAMERA, photos="photos/b.jpg") == 0
    again = json.loads(capsys.readouterr().out)["pose"]
    np.testing.assert_allclose(again["quat_wxyz"], POSES["b.jpg"].quat_wxyz, atol=1e-9)


def test_a_photo_that_the_file_lacks_fails_alone(capsys, folder):
    (folder / "rough.txt").write_text(format_pose("a.jpg", POSES["a.jpg"]) + "\n")
    assert localize(folder, *start(folder)) == 3
    told = capsys.readouterr().out
    assert f"b.jpg: {folder / 'rough.txt'} has no pose of b.jpg" in told
    assert "hint: --start needs one of each photo" in told
    assert "2 photos: 1 of unknown trust, 1 failed" in told


def test_what_fails_alike_is_one_line_and_a_hint_that_fits_a_folder(capsys, folder):
    assert localize(folder) == 1
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
    words = ["--height", "60", "--heading", "40", "--pitch", "-50", "--camera", CAMERA]
    photo = Image.open(folder / "photos" / "a.jpg")
    exif = photo.getexif()
    exif.get_ifd(0x8825).update({1: "N", 2: (51.0, 1.0, 2.0), 3: "E", 4: (5.0, 1.0, 2.0)})
    photo.save(folder / "photos" / "a.jpg", exif=exif)
    (folder / "photos" / "b.jpg").unlink()
    assert localize(folder, *words) == 1
    told = capsys.readouterr().out
    assert "names no reference system" in told
    assert (
        "hint: Name it with --crs, or give --start FILE with a rough pose of each photo by its name." in told
    )


def test_a_file_of_other_photos_or_none_is_one_line(capsys, folder):
    (folder / "rough.txt").write_text(format_pose("other.jpg", POSES["a.jpg"]) + "\n")
    assert localize(folder, *start(folder)) == 2
    told = capsys.readouterr().err
    assert "has none of these photos" in told
    assert "Its images are called other.jpg." in told
    assert localize(folder, "--start", "nowhere.txt") == 2
    assert "nowhere.txt does not exist" in capsys.readouterr().err


def test_from_python(folder):
    from lodbench import localize_photo

    found = localize_photo(
        folder / "photos" / "b.jpg",
        folder / "city.obj",
        start=folder / "rough.txt",
        camera=CAMERA,
        method="prior_only",
        out=folder / "out",
    )
    np.testing.assert_allclose(found.pose.center, POSES["b.jpg"].center, atol=1e-6)


def test_an_unreliable_pose_of_a_photo_without_a_roll_hints_at_it(capsys, folder):
    """By a mask that no building fits; a roll that is given, or comes with a pose, is not asked for."""
    specks = np.random.default_rng(1).uniform(size=(48, 64)) < 0.1
    Image.fromarray((255 * specks).astype(np.uint8)).save(folder / "mask.png")
    mask = ("--method", "lodlocv2", "--method-option", "steps=1", "--mask", str(folder / "mask.png"))
    place = (*"--center 5 44 80 --heading 173.80 --pitch -63.25 --camera".split(), CAMERA)
    said = {}
    for name, words in {"none": place, "given": (*place, "--roll", "0"), "file": start(folder)}.items():
        assert localize(folder, *words, *mask, photos="photos/b.jpg") == 3
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
    assert localize(folder, *start(folder)) == 0
    with (folder / "out" / "localized.csv").open() as stream:
        found = {row["photo"]: float(row["easting_m"]) for row in csv.DictReader(stream)}
    assert found == {str(paths[0]): -30.0, str(paths[1]): 5.0}


def test_a_plain_table_and_lodbench_s_own_begin_at_the_same_poses(capsys, folder):
    (folder / "rough.txt").write_text(
        "photo;x;y;altitude (m);yaw;pitch;roll\n"
        "a.jpg;-30;-40;60;40;-50;0\n"
        "b.jpg;5;44;80;173.8;-63.25;-120.6\n"
    )  # fmt: skip
    assert localize(folder, *start(folder)) == 0
    found = (folder / "out" / "localized.csv").read_text()
    capsys.readouterr()
    again = (
        "--start",
        str(folder / "out" / "localized.csv"),
        "--camera",
        CAMERA,
        "--out",
        str(folder / "again"),
    )
    assert localize(folder, *again) == 0
    assert (folder / "again" / "localized.csv").read_text() == found
    with (folder / "out" / "localized.csv").open() as stream:
        rows = {Path(row["photo"]).name: row for row in csv.DictReader(stream)}
    for name, pose in POSES.items():
        values = [float(rows[name][key]) for key in ("easting_m", "northing_m", "height_m")]
        assert values == pytest.approx(pose.center, abs=1e-3)
    assert [float(rows["b.jpg"][key]) for key in ("heading_deg", "pitch_deg", "roll_deg")] == pytest.approx(
        [173.8, -63.25, -120.6], abs=1e-3
    )
