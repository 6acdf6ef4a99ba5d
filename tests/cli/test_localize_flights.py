"""`lodbench localize` of flights: told apart, solved jointly, and what is left out named with its reason."""

import csv
import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.cli import main
from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.pose_text import FoundPose
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.harness.photo.many import (
    FINDINGS_FILE,
    FLIGHTS_FILE,
    PhotoAnswer,
    default_workers,
    write_answers,
)
from lodbench.harness.photo.prepare import PhotoRequest
from lodbench.methods.region import Region
from lodbench.rendering import make_renderer
from lodbench.reporting.answers import UNTRUSTED
from lodbench.synthesis.views import view_of
from tests.flight import OFF_DEG, OFF_M, stated
from tests.photos.dji_photo import exif_of, write_photo, xmp_packet

CAMERA = Camera(400, 300, 290.0, 290.0, 200.0, 150.0)
CRS = "EPSG:25832+7837"
COUNT = 4


@dataclass
class Flight:
    """Photos, their masks, and the truth behind them."""

    photos: Path
    masks: Path
    city: Path
    truth: dict[str, Pose]


@pytest.fixture(scope="module")
def flight(tmp_path_factory, shared_data) -> Flight:
    """Half a circle round the middle of a real tile, metadata off by what a drone's is, alike in all."""
    folder = tmp_path_factory.mktemp("flight")
    city = shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml"
    scene = open_scene(city)
    renderer = make_renderer("silhouette", scene)
    middle = np.median(scene.vertices.astype(float), axis=0)
    found = Flight(folder / "photos", folder / "masks", city, {})
    for part in (found.photos, found.masks):
        part.mkdir()
    for number in range(COUNT):
        pose = view_of(middle, 110.0, EulerAngles(40.0, 0.3, 50.0 * number))
        mask = renderer.render(CAMERA, pose).astype(np.uint8) * 255
        name = f"DJI_{number + 1:04d}"
        write(found.photos / f"{name}.JPG", pose.shifted(scene.origin), f"11:46:{10 + number:02d}", mask)
        cv2.imwrite(str(found.masks / f"{name}.png"), mask)
        found.truth[f"{name}.JPG"] = pose.shifted(scene.origin)
    return found


def write(photo: Path, pose: Pose, clock: str, mask: np.ndarray, **changed: str) -> None:
    said = stated(pose, CAMERA, CRS) | changed
    exif = exif_of().replace(b"11:46:19", clock.encode())
    packet = xmp_packet({key: value for key, value in said.items() if value})
    write_photo(photo, (90 + mask // 3).astype(np.uint8), exif, packet)


PLACE = ("easting_m", "northing_m", "height_m")


def localize(capsys, *words: object) -> tuple[int, str]:
    code = main(["localize", *map(str, words)])
    return code, capsys.readouterr().out


def errors_m(out: Path, truth: dict[str, Pose]) -> dict[str, float]:
    """Returns how far each photo of a table was found from its truth, metres."""
    with (out / "localized.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["easting_m"]]
    return {
        Path(row["photo"]).name: float(
            np.linalg.norm([float(row[axis]) for axis in PLACE] - truth[Path(row["photo"]).name].center)
        )
        for row in rows
    }


@pytest.mark.slow
def test_a_flight_is_solved_as_a_whole(capsys, flight, tmp_path):
    code, output = localize(
        capsys, flight.photos, "--city", flight.city, "--masks", flight.masks, "--out", tmp_path
    )
    assert code == 0
    assert (
        f"flight 1: {COUNT} photos, DJI_0001.JPG to DJI_0004.JPG, FC6310R 400 x 300, 2023-10-18 11:46:10"
        in output
    )
    assert f"heights in the metadata are {OFF_M[2]:.0f}" in output
    errors = errors_m(tmp_path, flight.truth)
    assert len(errors) == COUNT
    assert max(errors.values()) < 1.0
    (values,) = json.loads((tmp_path / FLIGHTS_FILE).read_text())["flights"]
    # Sensors are off by what is to be taken away again; compass and yaw count in opposite directions.
    assert values["constants"]["height"]["value"] == pytest.approx(-OFF_M[2], abs=1.0)
    assert values["constants"]["yaw"]["value"] == pytest.approx(OFF_DEG, abs=0.5)
    assert json.loads((tmp_path / FINDINGS_FILE).read_text())["type"] == "FeatureCollection"
    found = json.loads((tmp_path / "DJI_0001.json").read_text())
    assert found["probability"] > 0.9
    assert (tmp_path / "DJI_0004_overlay.png").is_file()
    page = (tmp_path / "flight_1.html").read_text()
    assert "Photo by photo" in page
    assert page.count("<img alt") == COUNT


@pytest.mark.slow
def test_a_flight_is_solved_by_its_pixels(capsys, flight, tmp_path):
    words = ["--city", flight.city, "--method-option", "single=region", "--out", tmp_path / "out"]
    code, output = localize(capsys, flight.photos, *words)
    assert code in (0, 3)
    # The photos have two tones: none of the edges within roofs that photos are posed by.
    assert max(errors_m(tmp_path / "out", flight.truth).values()) < 1.5
    assert "masks guided by the map" not in output
    for option, said in (("singel=region", "single"), ("single=regoin", "region"), ("name", "no value")):
        words = ["--city", flight.city, "--method-option", option, "--out", tmp_path / "no"]
        assert main(["localize", *map(str, (flight.photos, *words))]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


@pytest.mark.slow
def test_a_reconstruction_ties_the_photos_and_xmp_is_written_beside_them(capsys, flight, tmp_path):
    photos = tmp_path / "photos"
    shutil.copytree(flight.photos, photos)
    (photos / "DJI_0002.xmp").write_text("stars of another program")
    middle = flight.truth["DJI_0001.JPG"].center
    model = [
        FoundPose(name, "", Pose.from_center(pose.rotation, 0.1 * (pose.center - middle)), CAMERA)
        for name, pose in flight.truth.items()
    ]
    write_colmap(model, tmp_path / "sparse")
    words = ["--city", flight.city, "--masks", flight.masks, "--out", tmp_path / "out"]
    more = ["--reconstruction", tmp_path / "sparse", "--sidecars"]
    code = main(["localize", *map(str, (photos, *words, *more))])
    output = capsys.readouterr()
    assert code == 0
    assert max(errors_m(tmp_path / "out", flight.truth).values()) < 0.7
    assert "3 written beside the photos; 1 of other programs left alone: DJI_0002.xmp" in output.err
    assert "GimbalYawDegree" in (photos / "DJI_0001.xmp").read_text()
    assert (photos / "DJI_0001.JPG").read_bytes() == (flight.photos / "DJI_0001.JPG").read_bytes()
    write_colmap([image._replace(name="other.jpg") for image in model[:1]], tmp_path / "other")
    assert main(["localize", *map(str, (photos, *words, "--reconstruction", tmp_path / "other"))]) == 2
    assert "has none of these photos" in capsys.readouterr().err


@pytest.mark.slow
def test_what_cannot_be_used_is_named_and_the_rest_is_solved(capsys, flight, tmp_path):
    folder = tmp_path / "all"
    shutil.copytree(flight.photos, folder / "a")
    shutil.copytree(flight.masks, folder / "masks")
    pose, mask = flight.truth["DJI_0001.JPG"], cv2.imread(str(flight.masks / "DJI_0001.png"), 0)
    put = {
        "town.JPG": {"GpsLatitude": "+48.1", "GpsLongitude": "+11.5"},
        **{f"nowhere_{k}.JPG": {"GpsLatitude": "", "GpsLongitude": ""} for k in range(3)},
    }
    for k, (name, changed) in enumerate(put.items()):
        write(folder / "a" / name, pose, f"11:47:{10 + k:02d}", mask, **changed)
        cv2.imwrite(str(folder / "masks" / f"{Path(name).stem}.png"), mask)
    (folder / "a" / "broken.JPG").write_bytes(b"no photo")
    shutil.copy(folder / "masks" / "town.png", folder / "masks" / "broken.png")
    shutil.copy(folder / "a" / "DJI_0002.JPG", folder / "a" / "copy.JPG")
    # One mask for two photos: a second card has a photo of the same name.
    (folder / "b").mkdir()
    write(folder / "b" / "DJI_0004.JPG", pose, "11:48:00", mask)
    # The clock jumps, and jumps back.
    write(folder / "a" / "DJI_0003.JPG", flight.truth["DJI_0003.JPG"], "03:00:00", mask)
    code, output = localize(capsys, folder, "--city", flight.city, "--out", tmp_path / "out")
    assert code == 3
    for line in (
        "town.JPG: By its position town.JPG was taken",
        f"failed: 3 photos ({', '.join(str(folder / f'a/nowhere_{k}.JPG') for k in range(3))}): the photo "
        "does not say where it was taken",
        "broken.JPG is not a JPEG, PNG or TIFF picture",
        "copy.JPG: it is a copy of",
        "DJI_0004.png may be of",
        "the clock jumps at photos that are placed by name: DJI_0003.JPG",
        "flight 1: 3 photos",
    ):
        assert line in output
    assert "flight 2" not in output
    errors = errors_m(tmp_path / "out", flight.truth)
    assert sorted(errors) == ["DJI_0001.JPG", "DJI_0002.JPG", "DJI_0003.JPG"]
    assert max(errors.values()) < 1.5
    left_out = json.loads((tmp_path / "out" / FLIGHTS_FILE).read_text())["left_out"]
    assert len(left_out) == 8


@pytest.mark.slow
def test_photos_of_one_wall_are_not_trusted_and_the_rest_of_the_command_works(capsys, flight, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    wall = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    wall[:, CAMERA.width // 2 :] = 255
    for mask in flight.masks.iterdir():
        cv2.imwrite(str(masks / mask.name), wall)
    code, output = localize(
        capsys, flight.photos, "--city", flight.city, "--masks", masks, "--out", tmp_path / "out"
    )
    assert code == 3
    assert "flight 1: 4 photos" in output
    with (tmp_path / "out" / "localized.csv").open() as stream:
        assert all(row["trust"] == UNTRUSTED for row in csv.DictReader(stream))


@pytest.mark.nightly
def test_answers_do_not_depend_on_the_number_of_processes(capsys, flight, tmp_path):
    photos = tmp_path / "photos"
    shutil.copytree(flight.photos, photos / "a")
    # Photos of one name, whose files are numbered; one of them has no place.
    (photos / "b").mkdir()
    for name, place in (("DJI_0001.JPG", {"GpsLatitude": "", "GpsLongitude": ""}), ("DJI_0002.JPG", {})):
        mask = cv2.imread(str((flight.masks / name).with_suffix(".png")), 0)
        write(photos / "b" / name, flight.truth[name], "11:47:10", mask, **place)
    for way in (["--each-alone", "--method", "region"], ["--method-option", "single=region"]):
        folders = [tmp_path / f"{way[0]}{workers}" for workers in (1, 3)]
        outputs = [
            localize(
                capsys, photos, "--city", flight.city, *way, "--out", folder, "--workers", folder.name[-1]
            )
            for folder in folders
        ]
        assert outputs[0][0] == outputs[1][0]
        assert outputs[0][1].replace(str(folders[0]), "") == outputs[1][1].replace(str(folders[1]), "")
        names = [sorted(file.name for file in folder.iterdir()) for folder in folders]
        assert names[0] == names[1]
        assert "DJI_0002_2_overlay.png" in names[0]
        for name in (name for name in names[0] if name.endswith((".csv", ".png", ".geojson"))):
            assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes()


def test_a_process_is_started_for_no_fewer_photos_than_pay(tmp_path, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    request = PhotoRequest(city=tmp_path, out=tmp_path, photo=tmp_path, method=Region())
    assert [default_workers(request, photos) for photos in (1, 7, 8, 100)] == [1, 1, 2, 4]
    assert default_workers(replace(request, segmenter=OfAnotherPackage()), 100) == 1


class OfAnotherPackage:
    """A segmenter that may hold a device."""


def test_sidecars_of_a_city_that_is_nowhere_are_refused_before_photos_are_solved(capsys, flight, tmp_path):
    city = tmp_path / "city.obj"
    city.write_text("o house\nv 0 0 0\nv 9 0 0\nv 0 9 5\nf 1 2 3\n")
    words = ["--city", city, "--masks", flight.masks, "--sidecars", "--out", tmp_path / "out"]
    assert main(["localize", *map(str, (flight.photos, *words))]) == 2
    assert "--sidecars need a city with a reference system" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_results_of_other_photos_are_not_written_over(capsys, flight, tmp_path):
    words = ["--city", flight.city, "--masks", flight.masks, "--out", tmp_path, "--each-alone"]
    one, two = (sorted(flight.photos.iterdir())[k : k + 2] for k in (0, 2))
    for photos in (one, two, one):
        assert localize(capsys, *photos, *words)[0] == 0
    assert sorted(path.name for path in tmp_path.glob("localized*.csv")) == [
        "localized.csv",
        "localized_2.csv",
    ]
    assert set(errors_m(tmp_path, flight.truth)) == {"DJI_0001.JPG", "DJI_0002.JPG"}


def test_photos_that_are_localised_alone_leave_what_their_flight_was_found_to_be(tmp_path):
    answers = [PhotoAnswer(Path("DJI_0001.JPG"), None, "it has no pose")]
    assert write_answers(tmp_path, answers, []).table.name == "localized.csv"
    (tmp_path / FLIGHTS_FILE).write_text("of the flight")
    assert [write_answers(tmp_path, answers).table.name for _ in range(2)] == ["localized_2.csv"] * 2
    assert write_answers(tmp_path, answers, []).table.name == "localized.csv"


def test_findings_of_another_command_are_not_written_over(tmp_path):
    (tmp_path / FINDINGS_FILE).write_text("of georeference")
    written = write_answers(tmp_path, [PhotoAnswer(Path("DJI_0001.JPG"), None, "it has no pose")])
    assert written.table.name == "localized_2.csv"


@pytest.mark.slow
def test_an_orthophoto_lies_under_the_flight_s_map_and_pages_lead_to_each_other(capsys, tmp_path, flight):
    rasterio = pytest.importorskip("rasterio")
    east, north, _ = open_scene(flight.city).origin
    place = rasterio.transform.from_origin(east - 2000.0, north + 2000.0, 40.0, 40.0)
    profile = {"width": 100, "height": 100, "count": 3, "dtype": "uint8", "crs": "EPSG:25832"}
    for name, moved in (("dop.tif", place), ("far.tif", rasterio.Affine.translation(90_000.0, 0.0) @ place)):
        with rasterio.open(tmp_path / name, "w", driver="GTiff", transform=moved, **profile) as picture:
            picture.write(np.full((3, 100, 100), 90, np.uint8))
    words = [flight.photos, "--city", flight.city, "--masks", flight.masks, "--out", tmp_path / "out"]
    assert main(["localize", *map(str, words), "--imagery", str(tmp_path / "far.tif")]) == 2
    assert "km outside the city model" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    code, _ = localize(capsys, *words, "--imagery", tmp_path / "dop.tif")
    assert code == 0
    page = (tmp_path / "out" / "flight_1.html").read_text()
    assert '<image class="imagery" href="data:image/webp' in page
    assert 'href="localized_3d.html">The same in 3D' in page
    assert '<a href="flight_1.html">flight 1</a>' in (tmp_path / "out" / "localized_3d.html").read_text()


def test_imagery_is_for_flights(capsys, tmp_path, flight):
    photo = next(flight.photos.iterdir())
    for words in ([photo], [flight.photos, "--each-alone", "--masks", flight.masks]):
        command = ["localize", *words, "--city", flight.city, "--imagery", "dop.tif", "--out", tmp_path / "o"]
        assert main([*map(str, command)]) == 2
        assert "--imagery lies under the map of a flight's page." in capsys.readouterr().err
