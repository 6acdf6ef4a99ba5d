"""Localised photos: pixels and regions on the map, notes on places and heights, a real thermal query."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from pyproj import Transformer

import lodbench
from lodbench.cli import main
from lodbench.cli.locate import main as locate
from lodbench.datasets.pose_text import read_measurements
from tests.cli.photo_case import DISTORTION, HEIGHT, PINHOLE, WIDTH, Case, make_case
from tests.fault_commands import CRS, prepare_inputs
from tests.flight import stated
from tests.photos.dji_photo import exif_of, write_photo, xmp_packet
from tests.town import CAMERA, box_obj, true_poses


@dataclass
class Found:
    """A photo with lens distortion, and the folder that localize wrote."""

    case: Case
    folder: Path


@pytest.fixture(scope="module")
def found(tmp_path_factory, shared_data) -> Found:
    folder = tmp_path_factory.mktemp("locate")
    case = make_case(folder / "photo", shared_data, "nrw", distorted=True)
    words = ["localize", str(case.photo), "--city", str(case.city), "--mask", str(case.mask)]
    assert main([*words, "--out", str(folder / "found")]) == 0
    return Found(case, folder / "found")


def run(capsys, found: Found, *words: str, code: int = 0) -> dict:
    capsys.readouterr()
    where = [str(found.case.photo), "--city", str(found.case.city), "--found", str(found.folder), "--json"]
    assert locate([*where, *words]) == code
    return json.loads(capsys.readouterr().out)


def image_of(found: Found, place: np.ndarray) -> np.ndarray:
    """Returns the pixel of the photo as stored that shows a place, by the true pose and OpenCV's lens."""
    pose = found.case.truth
    at = (pose.rotation @ np.asarray(place) + pose.translation)[None]
    k1, k2, p1, p2, k3 = DISTORTION
    return cv2.projectPoints(at, np.zeros(3), np.zeros(3), PINHOLE.matrix, (k1, k2, p1, p2, k3))[0].ravel()


def test_places_project_back_to_their_pixels(capsys, found):
    pixels = [(340.0, 230.0), (60.5, 400.0), (600.0, 420.0)]
    output = run(capsys, found, *(f"{w}" for u, v in pixels for w in ("--pixel", u, v)))
    assert output["trusted"]
    for pixel, place in zip(pixels, output["places"], strict=True):
        at = np.array([place["east"], place["north"], place["height_m"]])
        # The pose is 8 cm off, a pixel some 0.3 m.
        np.testing.assert_allclose(image_of(found, at), pixel, atol=1.0)
        lon, lat = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True).transform(*at[:2])
        assert (place["longitude_deg"], place["latitude_deg"]) == pytest.approx((lon, lat), abs=1e-8)
        east, north, height = np.sqrt(np.diag(place["covariance_m2"]))
        assert place["ellipse95_minor_m"] <= 2.4478 * min(east, north) + 1e-3
        assert place["ellipse95_major_m"] >= 2.4477 * max(east, north) - 1e-3
        assert place["height_sigma_m"] == pytest.approx(height, abs=1e-3)
    features = json.loads(Path(output["map"]).read_text())["features"]
    assert [each["geometry"]["type"] for each in features] == ["Point"] * 3
    first = output["places"][0]
    assert features[0]["geometry"]["coordinates"] == pytest.approx(
        [first["longitude_deg"], first["latitude_deg"]], abs=1e-7
    )
    assert features[0]["properties"]["ellipse95_bearing_deg"] == first["ellipse95_bearing_deg"]


def test_the_answer_is_that_of_python(capsys, found):
    place = run(capsys, found, "--pixel", "340", "230")["places"][0]
    values = json.loads((found.folder / "DJI_0001.json").read_text())
    camera = lodbench.Camera.from_colmap(
        "FULL_OPENCV", WIDTH, HEIGHT, [float(v) for v in values["camera"]["as_stored"].split()[3:]]
    )
    pose = lodbench.Pose.from_quaternion(values["pose"]["quat_wxyz"], values["pose"]["translation_m"])
    scene = lodbench.open_scene(found.case.city)
    one = lodbench.locate(scene, camera, pose, (340, 230), np.array(values["covariance"]))
    np.testing.assert_allclose(one.place, [place["east"], place["north"], place["height_m"]], atol=1e-3)
    np.testing.assert_allclose(one.covariance, place["covariance_m2"], atol=1e-5)


def test_regions_become_polygons_of_the_right_size(capsys, found, tmp_path):
    """A square on the ground with a hole, and a small one, drawn by the true pose; the map is laid back."""
    flat = run(capsys, found, "--pixel", "420", "395")["places"][0]
    middle = np.array([flat["east"], flat["north"], flat["height_m"]])
    mask = np.zeros((2 * HEIGHT, 2 * WIDTH), np.uint8)
    squares = [((0.0, 0.0), 6.0, 255), ((0.0, 0.0), 2.0, 0), ((-9.0, 6.0), 1.5, 255)]
    for (east, north), half, value in squares:
        corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
        offsets = [np.array([east + x, north + y, 0.0]) for x, y in corners]
        ring = [image_of(found, middle + offset) * 2 - 0.5 for offset in offsets]
        cv2.fillPoly(mask, [np.rint(ring).astype(np.int32)], value)
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    out = tmp_path / "places.geojson"
    output = run(capsys, found, "--mask", str(tmp_path / "mask.png"), "--out", str(out))
    assert [each["name"] for each in output["places"]] == ["region 1", "region 2"]
    large, small = output["places"]
    assert large["area_m2"] == pytest.approx(144 - 16, rel=0.1)
    assert small["area_m2"] == pytest.approx(9, rel=0.25)
    assert large["shows"] == ["ground"]
    features = json.loads(out.read_text())["features"]
    polygon = shapely.geometry.shape(features[0]["geometry"])
    assert isinstance(polygon, shapely.Polygon)
    assert polygon.exterior.is_ccw
    assert len(polygon.interiors) == 1
    to_map = Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True)
    on_map = shapely.transform(polygon, lambda at: np.stack(to_map.transform(*at.T), axis=1))
    assert on_map.area == pytest.approx(large["area_m2"], rel=0.002)
    assert np.hypot(*(np.array(on_map.centroid.coords[0]) - middle[:2])) < 0.5
    # Again over its own file, and not over another's.
    assert run(capsys, found, "--pixel", "340", "230", "--out", str(out))["map"] == str(out)


def test_the_table_says_what_was_hit(capsys, found):
    capsys.readouterr()
    words = [str(found.case.photo), "--city", str(found.case.city), "--found", str(found.folder)]
    assert locate([*words, "--pixel", "340", "230", "--mask", str(found.case.mask)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:4] == ["latitude", "longitude", "east", "north"]
    assert lines[1].startswith("340 230 ")
    assert lines[1].endswith("ground")
    assert lines[2].startswith("region 1")
    assert " more" in lines[2]
    assert lines[-1] == f"map: {found.folder / 'DJI_0001_places.geojson'}"


def test_what_cannot_be_placed_is_one_line(capsys, found, tmp_path):
    photo, city = str(found.case.photo), str(found.case.city)
    (tmp_path / "empty").mkdir()
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    cv2.imwrite(str(tmp_path / "tall.png"), np.full((WIDTH, HEIGHT), 255, np.uint8))
    old = json.loads((found.folder / "DJI_0001.json").read_text())
    del old["camera"]["as_stored"]
    (tmp_path / "old").mkdir()
    (tmp_path / "old/DJI_0001.json").write_text(json.dumps(old))
    (tmp_path / "other.geojson").write_text('{"type": "FeatureCollection", "features": [{"properties": {}}]}')
    (tmp_path / "other.obj").write_text(box_obj())
    here = ["--city", city, "--found", str(found.folder)]
    one = ["--pixel", "10", "10"]
    cases = [
        ([photo, *here], "nothing to place"),
        ([photo, *here, "--pixel", "700", "10"], "outside the photo of 684 x 456"),
        ([photo, *here, *one, "--ground-sigma", "-1"], "--ground-sigma=-1"),
        ([str(tmp_path / "no.jpg"), *here, *one], "does not exist"),
        (
            [photo, "--city", city, "--found", str(tmp_path / "nowhere"), *one],
            "no results of lodbench localize",
        ),
        ([photo, "--city", city, "--found", str(tmp_path / "empty"), *one], "holds no pose of DJI_0001.JPG"),
        ([photo, "--city", city, "--found", str(tmp_path / "old"), *one], "is no answer that can be read"),
        ([photo, *here, *one, "--out", str(tmp_path / "other.geojson")], "would be written over"),
        ([photo, "--city", str(tmp_path / "other.obj"), *here[2:], *one], "in no reference system"),
        ([photo, *here, "--mask", str(tmp_path / "black.png")], "is black"),
        ([photo, *here, "--mask", str(tmp_path / "tall.png")], "another aspect"),
    ]
    for words, said in cases:
        capsys.readouterr()
        assert main(["locate", *words]) == 2, words
        lines = capsys.readouterr().err.splitlines()
        assert said in lines[0], lines
        assert len(lines) <= 2


class TestWithoutReferenceSystem:
    """A local city, a photo that is not trusted, the sky, and a laser: what localize wrote is made up."""

    @pytest.fixture
    def local(self, tmp_path) -> list[str]:
        from lodbench.storage import file_digest

        (tmp_path / "city.obj").write_text(box_obj())
        packet = xmp_packet({"LRFStatus": "Normal", "LRFTargetDistance": "40.5"})
        photo = write_photo(tmp_path / "a.jpg", np.full((480, 640), 99, np.uint8), exif_of(), packet)
        pose = lodbench.Pose.from_euler(lodbench.EulerAngles(60, 0, 0), (5.0, -100.0, 60.0))
        (tmp_path / "found").mkdir()
        values = {
            "sha256": file_digest(photo),
            "photo": photo.name,
            **dict.fromkeys(("score", "probability")),
            "crs": None,
            "pose": {"quat_wxyz": pose.quat_wxyz, "translation_m": pose.translation.tolist()},
            "covariance": np.diag([0.5, 0.5, 0.5, 0.02, 0.02, 0.02]).tolist(),
            "camera": {"as_stored": "PINHOLE 640 480 400 400 320 240"},
            "trusted": False,
            "trust": "do not trust",
        }
        (tmp_path / "found/a.json").write_text(json.dumps(values))
        return [
            "locate",
            str(photo),
            "--city",
            str(tmp_path / "city.obj"),
            "--found",
            str(tmp_path / "found"),
        ]

    def test_places_are_local_and_not_trusted(self, local, capsys):
        assert main([*local, "--pixel", "320", "240"]) == 3
        output = capsys.readouterr().out
        assert "latitude" not in output
        assert "pose is unreliable" in output
        assert "no GeoJSON was written" in output
        assert not list(Path(local[-1]).glob("*.geojson"))

    def test_the_laser_contradicts_aloud(self, local, capsys):
        assert main([*local, "--pixel", "320", "240"]) == 3
        assert "the laser measured 40.5 m" in capsys.readouterr().out

    def test_the_sky_is_one_line_for_a_pixel_and_a_note_for_a_region(self, local, capsys, tmp_path):
        assert main([*local, "--pixel", "320", "1"]) == 2
        assert "pixel 320 1 meets neither" in capsys.readouterr().err
        mask = np.zeros((480, 640), np.uint8)
        mask[:40, :200] = 255
        cv2.imwrite(str(tmp_path / "m.png"), mask)
        assert main([*local, "--mask", str(tmp_path / "m.png")]) == 2
        assert "shows the sky" in capsys.readouterr().err
        mask[300:330, 300:330] = 255
        cv2.imwrite(str(tmp_path / "m.png"), mask)
        assert main([*local, "--mask", str(tmp_path / "m.png")]) == 3
        assert "region 1 reaches the sky: left out" in capsys.readouterr().out


# Without a height system no height above the ellipsoid can be converted.
NO_HEIGHTS, ELLIPSOID = "EPSG:25832", ("--heights", "ellipsoid")
SAID = "note: --geoid was not used"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A town, a model of three views over it, and photos that state where they were taken."""
    made = prepare_inputs(tmp_path_factory.mktemp("notes"))
    (made / "photos").mkdir()
    for name, pose in true_poses(3).items():
        pixels = np.full((CAMERA.height, CAMERA.width), 90, np.uint8)
        write_photo(made / "photos" / name, pixels, exif_of(), xmp_packet(stated(pose, CAMERA, CRS)))
    return made


CASES = {
    "init": "dataset init {out} --images {in}/photos",
    "import": "dataset import colmap {in}/model {out} --images {in}/photos",
    "georeference": "georeference {in}/model --images {in}/photos --masks {in}/three/data/masks --out {out}",
    "track": "track {in}/photos --masks {in}/three/data/masks --out {out}",
}


@pytest.mark.parametrize("words", CASES.values(), ids=CASES)
def test_a_geoid_that_was_not_used_is_told(folder, capsys, tmp_path, words):
    given = f"{words} --city {{in}}/three/city.obj --crs {CRS} --geoid 46"
    code = main([word.format(**{"in": folder, "out": tmp_path / "out"}) for word in given.split()])
    told = capsys.readouterr()
    assert code in (0, 3), told.err
    assert SAID in told.out


def test_photos_that_state_no_rough_pose_are_told(folder, capsys, tmp_path):
    words = ["dataset", "import", "colmap", str(folder / "model"), str(tmp_path / "own")]
    words += [
        "--images",
        str(folder / "photos"),
        "--city",
        str(folder / "three/city.obj"),
        "--crs",
        NO_HEIGHTS,
    ]
    assert main([*words, "--heights", "ellipsoid"]) == 0
    (note,) = [line for line in capsys.readouterr().out.splitlines() if "note:" in line]
    assert "3 of 3 photos state no rough pose; the first, view_00.png: Heights above the ellipsoid" in note


def test_a_model_is_not_placed_for_the_reason_that_its_photos_have(folder, capsys, tmp_path):
    words = [
        "georeference",
        str(folder / "model"),
        "--images",
        str(folder / "photos"),
        "--heights",
        "ellipsoid",
    ]
    words += ["--city", str(folder / "three/city.obj"), "--crs", NO_HEIGHTS, "--out", str(tmp_path / "out")]
    assert main([*words, "--masks", str(folder / "three/data/masks")]) == 2
    said, hint = capsys.readouterr().err.splitlines()
    assert "0 of the model's 3 cameras have a rough place" in said
    assert "Heights above the ellipsoid" in said
    assert "--geoid" in hint


@pytest.mark.attack
def test_what_libjpeg_says_of_a_damaged_photo_does_not_reach_the_terminal(
    folder, lodbench_process, tmp_path, capfd
):
    content = bytearray((folder / "flight" / "DJI_00.JPG").read_bytes())
    content[-300:-290] = bytes(10)
    (tmp_path / "DJI_00.JPG").write_bytes(content)
    assert cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) is not None
    assert "Corrupt JPEG data" in capfd.readouterr().err
    mask, city = folder / "flight_masks" / "DJI_00.png", folder / "town" / "city.obj"
    done = lodbench_process(
        *("localize", "DJI_00.JPG", "--mask", str(mask), "--city", str(city), "--crs", CRS)
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert (tmp_path / "localized" / "DJI_00_overlay.png").is_file()
    assert "cannot be decoded" not in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(("tilt", "within_m", "within_deg"), [("truth", 2.0, 0.5), ("prior", 5.0, 2.0)])
def test_every_seed_finds_the_camera(lodbench, tmp_path, shared_data, tilt, within_m, within_deg):
    folder = shared_data / "uavd4l"
    done = lodbench(
        "run",
        "--multirun",
        "dataset=folder",
        f"dataset.root={folder / 'demo'}",
        f"dataset.city_model={folder / 'UAVD4L-LoD1.obj'}",
        "segmenter=masks",
        f"tilt={tilt}",
        "seed=0,1,2,3,4",
    )
    assert done.returncode == 0, done.stderr
    tables = list((tmp_path / "runs" / "folder" / "lodlocv2").glob("*/queries.csv"))
    assert len(tables) == 5
    for table in tables:
        (row,) = csv.DictReader(table.open())
        assert float(row["prior_translation_error_m"]) == pytest.approx(21.1, abs=0.05)
        assert float(row["translation_error_m"]) < within_m
        assert float(row["rotation_error_deg"]) < within_deg


def test_six_degrees_of_freedom_find_it_with_the_sensor_s_tilt(lodbench, tmp_path, shared_data):
    folder = shared_data / "uavd4l"
    done = lodbench(
        "run",
        "method=contour_alignment",
        "dataset=folder",
        f"dataset.root={folder / 'demo'}",
        f"dataset.city_model={folder / 'UAVD4L-LoD1.obj'}",
        "segmenter=masks",
        "tilt=prior",
    )
    assert done.returncode == 0, done.stderr
    (table,) = (tmp_path / "runs" / "folder" / "contour_alignment").glob("*/queries.csv")
    (row,) = csv.DictReader(table.open())
    assert float(row["translation_error_m"]) < 2.5
    assert float(row["rotation_error_deg"]) < 1.0
    assert 0.5 < float(row["probability"]) <= 1.0
    assert len(row["covariance"].split()) == 21


RTK = {"RtkFlag": "50", "RtkStdLon": "0.02", "RtkStdLat": "0.02", "RtkStdHgt": "0.03"}


def measured_photo(folder: Path, **changes: str) -> Path:
    name, pose = next(iter(true_poses(3).items()))
    pixels = np.full((CAMERA.height, CAMERA.width), 90, np.uint8)
    packet = xmp_packet(stated(pose, CAMERA, CRS) | RTK | changes)
    return write_photo(folder / Path(name).with_suffix(".jpg").name, pixels, exif_of(), packet)


def test_what_a_photo_measured_is_used_or_refused_aloud(folder, capsys, tmp_path):
    photo = measured_photo(tmp_path, LRFStatus="Normal", LRFTargetDistance="900", RtkStdHgt="-1")
    words = ["localize", str(photo), "--city", str(folder / "three/city.obj"), "--crs", CRS, "--geoid", "0"]
    words += [
        "--mask",
        str(folder / "three/data/masks" / f"{photo.stem}.png"),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(words) in (0, 3)
    found = json.loads((tmp_path / "out" / f"{photo.stem}.json").read_text())
    notes = " ".join(found["notes"])
    assert "the rough pose is known to east 1 m, north 1 m (standard deviations)" in notes
    assert "RtkStdHgt '-1' is no standard deviation: not used" in notes
    assert "the laser measured 900.0 m" in notes
    assert "laser_used" not in found
    # Whoever says how far off the rough pose may be is believed rather than the photo.
    assert main([*words, "--prior-range", "5"]) in (0, 3)
    assert "rough pose is known" not in (tmp_path / "out" / f"{photo.stem}.json").read_text()


def test_a_dataset_keeps_what_photos_measured(folder, capsys, tmp_path):
    (tmp_path / "photos").mkdir()
    measured_photo(tmp_path / "photos", LRFStatus="Normal", LRFTargetDistance="101.5")
    words = ["dataset", "init", str(tmp_path / "own"), "--images", str(tmp_path / "photos")]
    assert main([*words, "--city", str(folder / "three/city.obj"), "--crs", CRS, "--geoid", "0"]) == 0
    (measured,) = read_measurements(tmp_path / "own" / "measurements.txt").values()
    assert measured.sigmas[:3] == pytest.approx([1.0, 1.0, 1.0], abs=1e-3)
    assert measured.laser.range_m == 101.5
    assert measured.laser.sigma_m == pytest.approx(0.2 + 0.0015 * 101.5)
    assert measured.takeoff_height_m is not None
