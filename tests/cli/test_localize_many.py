"""`lodbench localize` of many photos: a table, a map, nothing written over, what fails named."""

import csv
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from PIL import Image
from shapely.geometry import Point, shape

from lodbench.cli import main
from lodbench.datasets.exchange.geojson import footprint_feature
from lodbench.datasets.own import find_mask
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.harness.photo import many
from lodbench.photos.files import find_photos
from lodbench.photos.map_frame import MapFrame
from lodbench.segmentation import protocol
from tests.cli.photo_case import Case, make_case


@pytest.fixture(scope="module")
def case(tmp_path_factory, shared_data) -> Case:
    return make_case(tmp_path_factory.mktemp("one"), shared_data, "nrw")


@pytest.fixture(scope="module")
def flight(case, tmp_path_factory) -> Path:
    """Two folders with a photo of one name each, one of which says nothing, and masks."""
    folder = tmp_path_factory.mktemp("flight")
    for part in ("a", "b", "masks"):
        (folder / part).mkdir()
    shutil.copy(case.photo, folder / "a" / "DJI_0001.JPG")
    # The same metadata, another file.
    (folder / "b" / "DJI_0001.JPG").write_bytes(case.photo.read_bytes() + b"\0")
    Image.new("RGB", (64, 48)).save(folder / "b" / "silent.jpg")
    shutil.copy(case.mask, folder / "masks" / "DJI_0001.png")
    cv2.imwrite(str(folder / "masks" / "silent.png"), np.zeros((48, 64), np.uint8))
    return folder


def test_each_photo_has_its_row_its_place_and_its_own_files(capsys, case, flight, tmp_path):
    out = tmp_path / "out"
    words = [flight / "a", flight / "b", "--city", case.city, "--masks", flight / "masks", "--out", out]
    words += ["--each-alone"]
    code = main(["localize", *map(str, words)])
    told = capsys.readouterr().out
    # One failed, so not all is well; two were found.
    assert code == 3
    assert "3 photos: 2 doubtful, 1 failed" in told
    missing = (
        "silent.jpg does not say where it was taken, how high it was (absolute), where its camera looked"
    )
    assert missing in told
    assert "focal length" in told
    assert (
        "hint: lodbench localize takes --start FILE with a rough pose of each photo by its name and --camera"
        in told
    )
    with (out / "localized.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["photo"] for row in rows] == [
        str(flight / "a/DJI_0001.JPG"), str(flight / "b/DJI_0001.JPG"), str(flight / "b/silent.jpg")
    ]  # fmt: skip
    truth = case.frame.place_of(case.truth)
    for row in rows[:2]:
        assert float(row["latitude_deg"]) == pytest.approx(truth.latitude_deg, abs=2e-5)
        assert float(row["height_m"]) == pytest.approx(truth.height_m, abs=2.0)
        assert row["failure"] == ""
    assert rows[2]["trust"] == "failed"
    assert sorted(path.name for path in out.glob("*.png")) == [
        "DJI_0001_2_overlay.png", "DJI_0001_overlay.png"
    ]  # fmt: skip
    features = json.loads((out / "localized.geojson").read_text())["features"]
    kinds = [feature["properties"].get("kind") for feature in features]
    assert kinds.count("estimate") == kinds.count("footprint") == 2
    assert features[-1]["geometry"] is None
    assert "does not say" in features[-1]["properties"]["failure"]
    # The same photos again are the same files.
    main(["localize", *map(str, words)])
    assert len(list(out.glob("*_overlay.png"))) == 2


class TestCodeOfOthers:
    """A plug-in that raises on one photo takes no other with it, and shows where it raised."""

    @pytest.fixture
    def sometimes(self, monkeypatch, case) -> None:
        @dataclass(frozen=True)
        class Params:
            name: str = "sometimes"

        class Sometimes:
            params_type, name = Params, "sometimes"

            def __init__(self, params: Params) -> None:
                self.params = params

            def segment(self, entry):
                if entry.image.name == "DJI_0002.JPG":
                    raise IndexError("no such row")
                return cv2.imread(str(case.mask), cv2.IMREAD_UNCHANGED).astype(np.float32) / 255

        plain = protocol.load_plugin
        monkeypatch.setattr(
            protocol,
            "load_plugin",
            lambda group, name: (
                Sometimes if (group, name) == ("segmenters", "sometimes") else plain(group, name)
            ),
        )

    @pytest.fixture
    def photos(self, case, tmp_path) -> Path:
        (tmp_path / "flight").mkdir()
        # The same metadata, another file: copies are left out.
        for number in (1, 2):
            content = case.photo.read_bytes() + bytes(number)
            (tmp_path / "flight" / f"DJI_000{number}.JPG").write_bytes(content)
        return tmp_path / "flight"

    @pytest.mark.slow
    @pytest.mark.parametrize("alone", [("--each-alone",), ()])
    def test_a_segmenter_that_raises_on_one_photo(self, capsys, case, photos, tmp_path, sometimes, alone):
        out = tmp_path / "out"
        words = [photos, "--city", case.city, "--segmenter", "sometimes", "--out", out, *alone]
        assert main(["localize", *map(str, words)]) == 3
        assert "segmenter sometimes raised IndexError: no such row" in capsys.readouterr().out
        with (out / "localized.csv").open() as stream:
            rows = list(csv.DictReader(stream))
        assert [bool(row["failure"]) for row in rows] == [False, True]
        assert "in segment" in (out / "tracebacks" / "DJI_0002.JPG.txt").read_text()

    def test_a_method_that_raises_on_a_flight(self, capsys, case, photos, tmp_path, monkeypatch):
        def raising(*_: object) -> None:
            raise ZeroDivisionError("by nothing")

        monkeypatch.setattr("lodbench.methods.flight.FlightMethod.localize_flight", raising)
        words = [photos, "--city", case.city, "--out", tmp_path / "out"]
        assert main(["localize", *map(str, words)]) == 1
        assert "method flight raised ZeroDivisionError: by nothing" in capsys.readouterr().out
        assert "in raising" in (tmp_path / "out/tracebacks/flight.txt").read_text()

    def test_a_method_that_raises_on_the_one_photo(self, capsys, case, tmp_path, monkeypatch):
        def raising(*_: object) -> None:
            raise ZeroDivisionError

        monkeypatch.setattr("lodbench.methods.region.Region.localize", raising)
        out = tmp_path / "out"
        assert main(["localize", str(case.photo), "--city", str(case.city), "--out", str(out)]) == 2
        error = capsys.readouterr().err
        assert error.splitlines()[0] == "lodbench: method auto raised ZeroDivisionError"
        assert str(out / "tracebacks" / f"{case.photo.name}.txt") in error


class TestFartherOff:
    """How far off the rough pose may be is told by those options, to the method by pixels and by mask."""

    @pytest.fixture
    def far(self, case, tmp_path) -> list[str]:
        place = case.frame.place_of(case.truth)
        north = ["--lat", str(place.latitude_deg + 120.0 / 111_200.0), "--lon", str(place.longitude_deg)]
        return [str(case.photo), "--city", str(case.city), "--out", str(tmp_path), "--json", *north]

    @pytest.mark.slow
    @pytest.mark.parametrize("by_mask", [False, True])
    def test_a_place_120_m_off_is_found_where_that_is_told(self, capsys, case, far, by_mask):
        words = ["localize", *far, *(["--mask", str(case.mask)] if by_mask else [])]
        if by_mask:
            assert main(words) == 3
            assert any("--prior-range" in note for note in json.loads(capsys.readouterr().out)["notes"])
        assert main([*words, "--prior-range", "150"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert np.linalg.norm(np.array(found["pose"]["center_m"]) - case.truth.center) < 2.0

    def test_what_cannot_be_told(self, capsys, far, flight, case):
        assert main(["localize", *far, "--prior-range", "-5"]) == 2
        assert "--prior-range=-5 is not" in capsys.readouterr().err
        for words in (["--prior-range", "3000"], ["--prior-height", "1e9"], ["--prior-yaw", "400"]):
            assert main(["localize", *far, *words]) == 2
            assert f"{words[0]}={float(words[1]):g} is not" in capsys.readouterr().err
        words = [str(flight / "a"), str(flight / "b"), "--city", str(case.city), "--prior-yaw", "180"]
        assert main(["localize", *words]) == 2
        assert "take --each-alone" in capsys.readouterr().err


def test_a_mask_saved_beside_its_photo_is_no_photo(capsys, case, tmp_path):
    folder = tmp_path / "flight"
    folder.mkdir()
    shutil.copy(case.photo, folder / "DJI_0001.JPG")
    assert main(["mask", str(folder / "DJI_0001.JPG"), "--mask", str(case.mask), "--no-page"]) == 0
    assert (folder / "DJI_0001_mask.png").is_file()
    assert find_photos(folder) == [folder / "DJI_0001.JPG"]
    # A picture of that name without its photo is one.
    shutil.copy(case.mask, folder / "DJI_0002_mask.png")
    assert len(find_photos(folder)) == 2
    # In a folder of masks it is found by that name, too; in the photo's own it is not the photo.
    assert find_mask(folder, "DJI_0001.JPG") == folder / "DJI_0001.JPG"
    mask = folder / "DJI_0001_mask.png"
    assert find_mask(folder, "DJI_0001.JPG", folder / "DJI_0001.JPG") == mask
    assert find_photos(folder, folder) == [folder / "DJI_0001.JPG", folder / "DJI_0002_mask.png"]
    shutil.copy(case.mask, folder / "DJI_0001.png")
    assert folder / "DJI_0001.png" not in find_photos(folder, folder)
    masks = tmp_path / "others"
    masks.mkdir()
    shutil.move(folder / "DJI_0001_mask.png", masks)
    assert find_mask(masks, "a/DJI_0001.JPG") == masks / "DJI_0001_mask.png"


class TestMasksBesideTheirPhotos:
    @pytest.fixture
    def photos(self, case, tmp_path) -> Path:
        folder = tmp_path / "flight"
        folder.mkdir()
        for number in (1, 2):
            (folder / f"DJI_000{number}.JPG").write_bytes(case.photo.read_bytes() + bytes(number))
        shutil.copy(case.mask, folder / "DJI_0001_mask.png")
        return folder

    def test_they_are_used_where_their_folder_is_named(self, capsys, case, photos, tmp_path):
        words = [photos, "--city", case.city, "--masks", photos, "--each-alone", "--out", tmp_path / "out"]
        assert main(["localize", *map(str, words)]) == 3
        told = capsys.readouterr()
        assert "2 photos: 1 doubtful, 1 failed" in told.out
        assert f"{photos} holds no mask of it" in told.out
        assert "not used" not in told.err

    def test_it_is_said_that_they_are_not_used_where_nothing_is_named(self, caplog, case, photos, tmp_path):
        words = ["--city", case.city, "--method", "prior_only", "--out", tmp_path / "out"]
        assert main(["localize", *map(str, [photos, *words, "--heading", 10])]) == 0
        told = caplog.text
        assert f"Masks beside 1 of the photos are not used; use them with --masks {photos}." in told
        assert "--heading 10 overrides the heading in the metadata of 2 photos" in told
        assert main(["localize", *map(str, [photos / "DJI_0001.JPG", *words])]) == 0
        told = caplog.text
        assert f"is not used; use it with --mask {photos / 'DJI_0001_mask.png'}." in told


def test_results_among_the_photos_are_none(capsys, case, tmp_path):
    shutil.copy(case.photo, tmp_path / "DJI_0001.JPG")
    words = ["--city", case.city, "--method", "prior_only"]
    for _ in range(2):
        assert main(["localize", *map(str, [tmp_path, *words, "--out", tmp_path])]) == 0
        assert "1 photo: 1 of unknown trust" in capsys.readouterr().out
    assert (tmp_path / "DJI_0001_overlay.png").is_file()
    # A picture of that name beside polygons that another program wrote is a photo.
    shutil.copy(case.mask, tmp_path / "house_overlay.png")
    (tmp_path / "house.json").write_text('{"shapes": []}')
    assert find_photos(tmp_path) == [tmp_path / "DJI_0001.JPG", tmp_path / "house_overlay.png"]
    assert not (tmp_path / "localized_2.csv").exists()


def test_names_that_are_no_text_and_what_shares_a_sidecar(capsys, case, tmp_path):
    """As from a card or an archive in another encoding; the other photos keep their rows."""
    folder = tmp_path / "flight"
    folder.mkdir()
    for number, name in enumerate((b"DJI_1.JPG", b"DJI_1.jpeg", b"DJI_\xe4.JPG")):
        (folder / os.fsdecode(name)).write_bytes(case.photo.read_bytes() + bytes(number))
    words = ["--city", case.city, "--method", "prior_only", "--out", tmp_path / "out", "--sidecars"]
    for more in ((), ("--json",)):
        assert main(["localize", *map(str, [folder, *words]), *more]) == 0
    told = capsys.readouterr()
    assert "3 photos: 3 of unknown trust" in told.out
    assert (
        "1 written beside the photos; 1 not written, which several photos would share: DJI_1.xmp" in told.err
    )
    with (tmp_path / "out" / "localized.csv").open() as stream:
        assert [row["photo"] for row in csv.DictReader(stream)][2].endswith("DJI_\\udce4.JPG")
    assert not (tmp_path / "out" / "localized_2.csv").exists()
    town = tmp_path / "town"
    assert main(["dataset", "init", str(town), "--images", str(folder), "--city", str(case.city)]) == 0
    assert (town / "Query_image" / "DJI__.JPG").is_file()


class TestFootprint:
    FRAME = MapFrame("EPSG:25832")
    CAMERA = Camera(400, 300, 300.0, 300.0, 200.0, 150.0)

    def ring(self, pitch_deg: float) -> np.ndarray:
        pose = Pose.from_euler(EulerAngles(pitch_deg, 0, 0), (500_000.0, 5_600_000.0, 160.0))
        feature = footprint_feature(self.FRAME, self.CAMERA, pose, 60.0, {})
        assert shape(feature["geometry"]).is_valid
        assert shape(feature["geometry"]).exterior.is_ccw
        points = [self.FRAME.east_north(lat, lon) for lon, lat in feature["geometry"]["coordinates"][0]]
        return np.array(points) - (500_000.0, 5_600_000.0)

    def test_straight_down_it_is_the_sensor_s_rectangle_on_the_ground(self):
        ring = self.ring(0.0)
        # 100 m above the ground: 400 px of focal length 300 are 133.3 m, 300 px are 100 m.
        assert np.ptp(ring, axis=0) == pytest.approx([400 / 3, 100.0], abs=0.05)
        assert ring.min(axis=0) == pytest.approx([-200 / 3, -50.0], abs=0.05)

    def test_above_the_horizon_it_ends_at_its_reach(self):
        ring = self.ring(75.0)
        far = np.hypot(*ring.T)
        assert far.max() == pytest.approx(600.0, rel=1e-3)
        lowest = 100.0 * np.tan(np.radians(75.0 - np.degrees(np.arctan(0.5))))
        assert ring[:, 1].min() == pytest.approx(lowest, rel=1e-3)

    def test_what_a_camera_below_the_ground_shows_is_nothing(self):
        pose = Pose.from_euler(EulerAngles(0, 0, 0), (500_000.0, 5_600_000.0, 50.0))
        assert footprint_feature(self.FRAME, self.CAMERA, pose, 60.0, {}) is None


def test_the_map_s_footprint_holds_what_the_middle_of_the_picture_shows(capsys, case, tmp_path):
    words = [str(case.photo), "--city", str(case.city), "--mask", str(case.mask), "--out", str(tmp_path)]
    assert main(["localize", *words]) == 0
    features = json.loads((tmp_path / "DJI_0001.geojson").read_text())["features"]
    (footprint,) = (shape(f["geometry"]) for f in features if f["properties"].get("kind") == "footprint")
    (view,) = (f for f in features if f["properties"].get("kind") == "view")
    assert footprint.buffer(1e-4).contains(Point(view["geometry"]["coordinates"][-1]))


def test_why_answers_are_not_to_be_trusted_is_said_photo_by_photo(
    capsys, case, flight, tmp_path, monkeypatch
):
    """Of many photos only the probability was told; that a heading was 25 degrees off stood in each JSON."""
    monkeypatch.setattr("lodbench.cli.localize_text._MOST_DOUBTS", 1)
    out, masks = tmp_path / "out", flight / "masks"
    heading = case.frame.place_of(case.truth).heading_deg + 25.0
    words = [
        flight / "a",
        flight / "b",
        "--city",
        case.city,
        "--masks",
        masks,
        "--out",
        out,
        "--heading",
        heading,
    ]
    assert main(["localize", *map(str, words), "--each-alone"]) == 3
    told = capsys.readouterr().out
    assert "3 photos: 2 not to be trusted, 1 failed" in told
    assert f"{flight}/a/DJI_0001.JPG: the pose lies outside the stated range" in told
    assert "and 1 more such notes in the table" in told
    assert (
        "correct their masks (lodbench mask PHOTO); widen the search if the rough pose may be far off" in told
    )
    with (out / "localized.csv").open() as stream:
        notes = [row["notes"] for row in csv.DictReader(stream)]
    assert [note.count("yaw") for note in notes] == [1, 1, 0]


def test_what_was_found_until_it_was_stopped_is_written(caplog, case, flight, tmp_path, monkeypatch):
    once, begun = many.localize_photo, []

    def stopped(request, **given):
        begun.append(request.photo)
        if len(begun) == 2:
            raise KeyboardInterrupt
        return once(request, **given)

    monkeypatch.setattr(many, "localize_photo", stopped)
    out = tmp_path / "out"
    words = [flight / "a", flight / "b", "--city", case.city, "--masks", flight / "masks", "--out", out]
    words = ["localize", *map(str, words), "--each-alone"]
    assert main(words) == 130
    with (out / "localized.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["trust"] for row in rows] == ["doubtful", "failed", "failed"]
    assert [row["failure"] for row in rows] == ["", *["stopped before its turn"] * 2]
    assert len(json.loads((out / "localized.geojson").read_text())["features"]) > 3
    assert f"1 of 3 photos were done until then: {out}" in caplog.text
    # The whole command takes its place; one that is stopped again does not.
    assert main(words) == 3
    whole = (out / "localized.csv").read_bytes()
    begun.clear()
    assert main(words) == 130
    assert (out / "localized.csv").read_bytes() == whole
    assert not (out / "localized_2.csv").exists()
    # A disk that is full by then is told, and hides nothing.
    begun.clear()
    full = OSError(28, "No space left on device", str(tmp_path / "full" / "localized.csv"))
    monkeypatch.setattr(many, "write_answers", Mock(side_effect=full))
    assert main([*words[:-2], str(tmp_path / "full"), words[-1]]) == 130
    assert "could not be kept" in caplog.text
    assert "localized.csv: No space left on device" in caplog.text
