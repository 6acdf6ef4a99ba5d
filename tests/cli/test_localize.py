"""One photo, end to end: real city models, photos and masks made at a known pose, metadata as a drone's."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.cli import main as cli
from lodbench.cli.localize import main
from lodbench.errors import DatasetError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.geometry import Camera, EulerAngles, Pose
from tests.cli.photo_case import CITIES, HEIGHT, PINHOLE, WIDTH, localize, make_case, pose_of
from tests.photos.dji_photo import exif_of, write_photo


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "distorted", "tilt_deg", "within_m", "within_deg"),
    [
        ("nrw", False, 0.0, 2.0, 1.0),
        ("nrw", True, 0.0, 2.0, 1.0),
        ("plateau", True, 0.0, 2.0, 1.0),
        ("3dbag", False, 0.0, 2.0, 1.0),
        ("3dbag", True, 0.7, 5.0, 2.0),
    ],
)
def test_the_camera_is_found(capsys, tmp_path, shared_data, name, distorted, tilt_deg, within_m, within_deg):
    case = make_case(tmp_path, shared_data, name, distorted=distorted, tilt_deg=tilt_deg)
    found = localize(capsys, case, tmp_path / "out", "--mask", str(case.mask))
    off = pose_error(pose_of(found["prior"]), case.truth)
    assert off.translation_m == pytest.approx(np.linalg.norm([6, -5, 11]), abs=0.05)
    assert 2.5 < off.rotation_deg < 3.5
    error = pose_error(pose_of(found["pose"]), case.truth)
    assert error.translation_m < within_m
    assert error.rotation_deg < within_deg
    expected = case.frame.place_of(case.truth)
    place = found["place"]
    assert place["latitude_deg"] == pytest.approx(expected.latitude_deg, abs=within_m / 111_000)
    assert place["longitude_deg"] == pytest.approx(expected.longitude_deg, abs=within_m / 60_000)
    assert place["height_m"] == pytest.approx(expected.height_m, abs=within_m)
    assert (place["heading_deg"] - expected.heading_deg + 180) % 360 - 180 == pytest.approx(0, abs=within_deg)
    assert any("distortion" in note for note in found["notes"]) == distorted
    assert cv2.imread(found["overlay"]).shape[1] == WIDTH
    points = {
        f["properties"].get("kind"): f["geometry"]["coordinates"]
        for f in json.loads(Path(found["geojson"]).read_text())["features"]
    }
    assert points["estimate"] == pytest.approx([place["longitude_deg"], place["latitude_deg"]], abs=1e-7)
    # What the middle of the picture shows lies ahead of the camera.
    (lon, lat), (lon2, lat2) = points["view"]
    bearing = np.degrees(np.arctan2((lon2 - lon) * np.cos(np.radians(lat)), lat2 - lat))
    assert (bearing - place["heading_deg"] + 180) % 360 - 180 == pytest.approx(0, abs=1.0)


class TestFromPixels:
    """No mask and no segmenter: the photo's own regions."""

    @pytest.mark.parametrize("distorted", [False, True])
    def test_the_camera_is_found_and_trusted(self, capsys, tmp_path, shared_data, distorted):
        case = make_case(tmp_path, shared_data, "nrw", distorted=distorted, tilt_deg=0.5)
        found = localize(capsys, case, tmp_path / "out")
        error = pose_error(pose_of(found["pose"]), case.truth)
        assert error.translation_m < 2.0
        assert error.rotation_deg < 1.0
        assert found["trusted"]
        assert found["trust"] in ("good", "doubtful")
        assert found["probability"] > 0.5
        assert set(found["sigmas"]) == {"x_m", "y_m", "z_m", "pitch_deg", "roll_deg", "yaw_deg"}
        variances = [row[k] for k, row in enumerate(found["covariance"])]
        assert [sigma**2 for sigma in found["sigmas"].values()] == pytest.approx(variances)
        assert cv2.imread(found["overlay"]).shape[1] == WIDTH

    @pytest.mark.slow
    def test_where_pixels_do_not_tell_a_mask_is_asked(self, capsys, tmp_path, shared_data, monkeypatch):
        from lodbench.methods import Estimate
        from lodbench.methods.region import Region
        from lodbench.segmentation.packaged import EfficientUnet

        def region_says(probability, moved_m=0.0, like=None):
            def localize(self, query, *_):
                rotation = query.prior.rotation if like is None else like.rotation
                pose = Pose.from_center(rotation, query.prior.center + moved_m)
                return Estimate(pose, 0.1, probability=probability)

            monkeypatch.setattr(Region, "localize", localize)

        case = make_case(tmp_path, shared_data, "nrw", distorted=True)
        region_says(0.1, moved_m=20.0)
        alone = localize(capsys, case, tmp_path / "out", code=3)
        right, prior = pose_of(alone["pose"]), pose_of(alone["prior"])
        assert pose_error(right, case.truth).translation_m < 2.0
        assert any("a segmenter's mask" in note and "10 %" in note for note in alone["notes"])
        assert "the mask was made by efficient_unet" in alone["notes"]
        # What the pixels said is still there, as another place.
        other = alone["alternatives"][0]
        assert pose_of(other).center == pytest.approx(prior.center + 20.0)
        assert other["probability"] == 0.1
        # Two that agree are believed more than one alone.
        region_says(0.1, moved_m=right.center - prior.center, like=right)
        both = localize(capsys, case, tmp_path / "both")
        assert both["pose"] == alone["pose"]
        assert both["probability"] == pytest.approx(2.0 * alone["probability"])
        # A mask that shows nothing changes nothing.
        nothing = np.zeros((HEIGHT, WIDTH), np.float32)
        with monkeypatch.context() as patch:
            patch.setattr(EfficientUnet, "segment", lambda *_: nothing)
            kept = localize(capsys, case, tmp_path / "nothing", code=3)
        assert pose_of(kept["pose"]).center == pytest.approx(right.center)
        assert any("a mask was tried as well, without result" in note for note in kept["notes"])
        # A method that was named, and an answer that is to be trusted, have no second one.
        region_says(0.1)
        assert localize(capsys, case, tmp_path / "named", "--method", "region", code=3)["moved_m"] == 0.0
        region_says(0.6, moved_m=right.center - prior.center, like=right)
        sure = localize(capsys, case, tmp_path / "sure")
        assert sure["probability"] == pytest.approx(0.6)
        assert not any("efficient_unet" in note for note in sure["notes"])
        # Of a pose that the photo's edges contradict nothing above an even chance is believed.
        region_says(0.6)
        contradicted = localize(capsys, case, tmp_path / "contradicted", "--method", "region", code=3)
        assert contradicted["probability"] < 0.5
        assert any("poor fit: edges in the photo" in note for note in contradicted["notes"])

    @pytest.mark.slow
    def test_a_photo_of_something_else_is_not_trusted(self, capsys, tmp_path, shared_data):
        case = make_case(tmp_path, shared_data, "nrw")
        tags = cv2.resize(np.random.default_rng(3).integers(0, 256, (9, 12), dtype=np.uint8), (WIDTH, HEIGHT))
        noise = np.random.default_rng(4).integers(0, 30, (HEIGHT, WIDTH), dtype=np.uint8)
        place = case.frame.place_of(case.truth)
        write_photo(case.photo, tags // 2 + noise)
        camera = f"PINHOLE {WIDTH} {HEIGHT} {PINHOLE.fx} {PINHOLE.fy} {PINHOLE.cx} {PINHOLE.cy}"
        words = ["--center", *map(str, case.truth.center + 4.0), "--heading", str(place.heading_deg)]
        words += ["--pitch", str(place.pitch_deg), "--camera", camera, "--out", str(tmp_path / "out")]
        assert cli(["localize", str(case.photo), "--city", str(case.city), *words]) == 3
        told = capsys.readouterr().out
        assert "do not trust" in told
        assert "--mask FILE" in told
        assert "within 2 m and 2 deg" in told


@pytest.mark.slow
def test_leaving_the_distortion_in_the_mask_is_worse(capsys, tmp_path, shared_data):
    case = make_case(tmp_path, shared_data, "nrw", distorted=True)
    good = localize(capsys, case, tmp_path / "a", "--mask", str(case.mask))
    pinhole = f"PINHOLE {WIDTH} {HEIGHT} {PINHOLE.fx} {PINHOLE.fy} {PINHOLE.cx} {PINHOLE.cy}"
    bad = localize(capsys, case, tmp_path / "b", "--mask", str(case.mask), "--camera", pinhole)
    assert bad["score"] < good["score"] - 0.05


@pytest.mark.slow
def test_a_segmenter_s_mask_is_undistorted_as_a_file_s(capsys, tmp_path, shared_data, monkeypatch):
    case = make_case(tmp_path, shared_data, "nrw", distorted=True)
    from_file = localize(capsys, case, tmp_path / "a", "--mask", str(case.mask))

    @dataclass(frozen=True)
    class Params:
        invert: bool = False

    class Segmenter:
        params_type = Params
        name = "mine"

        def __init__(self, params):
            self.params = params

        def segment(self, entry):
            assert entry.image == case.photo
            mask = cv2.imread(str(case.mask), cv2.IMREAD_UNCHANGED).astype(np.float32) / 255
            return 1 - mask if self.params.invert else mask

    import lodbench.segmentation.protocol as module

    plain = module.load_plugin
    monkeypatch.setattr(
        module, "load_plugin", lambda group, name: Segmenter if group == "segmenters" else plain(group, name)
    )
    found = localize(capsys, case, tmp_path / "b", "--segmenter", "mine")
    assert found["pose"] == from_file["pose"]
    inverted = localize(
        capsys, case, tmp_path / "c", "--segmenter", "mine", "--segmenter-option", "invert=true", code=3
    )
    assert inverted["score"] < found["score"]
    assert any("unreliable" in note for note in inverted["notes"])


def test_the_call_refuses_a_lens_it_cannot_see_through(shared_data):
    import lodbench

    scene = open_scene(shared_data / "city" / CITIES["nrw"][0])
    lens = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, (-0.1, 0.0, 0.0, 0.0))
    above = Pose.from_euler(EulerAngles(0, 0, 0), scene.origin + scene.vertices.mean(axis=0) + [0, 0, 100.0])
    with pytest.raises(lodbench.LodbenchError, match="distortion"):
        lodbench.localize(scene, lens, above, np.ones((48, 64), bool))


def test_a_photo_that_viewers_turn_is_told(capsys, tmp_path, shared_data):
    case = make_case(tmp_path, shared_data, "nrw")
    content = case.photo.read_bytes()
    packet = content[content.index(b"<?xpacket") : content.index(b'end="w"?>') + 9]
    pixels = cv2.imread(str(case.photo), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    write_photo(case.photo, pixels, exif_of(orientation=3), packet)
    found = localize(capsys, case, tmp_path / "o", "--mask", str(case.mask))
    assert any("EXIF rotates" in note for note in found["notes"])
    assert pose_error(pose_of(found["pose"]), case.truth).translation_m < 2.0


def test_how_well_the_focal_length_is_known_is_told(capsys, tmp_path, shared_data):
    """By EXIF, not by DJI's calibration: the height is open as far as the focal length is."""
    case = make_case(tmp_path, shared_data, "nrw")
    sure = localize(
        capsys, case, tmp_path / "sure", "--mask", str(case.mask), "--method", "contour_alignment"
    )
    case.photo.write_bytes(case.photo.read_bytes().replace(b"DewarpData", b"DewarpNone"))
    words = ["--mask", str(case.mask), "--method", "contour_alignment"]
    found = localize(capsys, case, tmp_path / "o", *words)
    assert (sure["camera"]["lens_percent"], found["camera"]["lens_percent"]) == (None, 1.0)
    assert sure["camera"]["sigmas"] == {
        "focal_percent": 0.5, "center_percent": 0.35, "k1": 0.01, "source": "dewarp"
    }  # fmt: skip
    assert found["camera"]["sigmas"]["focal_percent"] == 1.5
    assert found["sigmas"]["z_m"] > 1.5 * sure["sigmas"]["z_m"]
    assert main([str(case.photo), "--city", str(case.city), "--out", str(tmp_path / "text"), *words]) == 0
    assert "camera: sensor, its focal length good to 1.0 %" in capsys.readouterr().out


def test_a_height_above_another_zero_is_told(capsys, tmp_path, shared_data):
    case = make_case(tmp_path, shared_data, "nrw")
    words = [str(case.photo), "--city", str(case.city), "--out", str(tmp_path / "o")]
    with pytest.raises(DatasetError, match=r"taken 1[34]\d\d m below the city model") as fault:
        main([*words, "--height-offset", "-1500"])
    assert "--takeoff METRES" in fault.value.hint


def test_a_height_that_is_little_too_low_is_told_where_nothing_fits(capsys, tmp_path, shared_data):
    case = make_case(tmp_path, shared_data, "nrw")
    words = [
        str(case.photo),
        "--city",
        str(case.city),
        "--out",
        str(tmp_path / "o"),
        "--mask",
        str(case.mask),
    ]
    with pytest.raises(QueryFault, match=r"its rough place is \d\d m below the city's lowest point") as fault:
        main([*words, "--height", "5"])
    assert "--takeoff METRES" in fault.value.hint
    # Above ground it is something else.
    with pytest.raises(QueryFault) as fault:
        main([*words, "--heading", "0", "--pitch", "60"])
    assert "below" not in fault.value.message


def test_a_photo_that_a_program_turned_is_told_and_found_by_its_roll(capsys, tmp_path, shared_data):
    case = make_case(tmp_path, shared_data, "nrw")
    content = case.photo.read_bytes()
    packet = content[content.index(b"<?xpacket") : content.index(b'end="w"?>') + 9]
    for path in (case.photo, case.mask):
        pixels = np.ascontiguousarray(np.rot90(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))
        if path == case.photo:
            write_photo(path, pixels, exif_of(size=(WIDTH, HEIGHT)), packet)
        else:
            cv2.imwrite(str(path), pixels)
    words = "--mask", str(case.mask)
    lost = localize(capsys, case, tmp_path / "o", *words, code=3)
    assert any("rotated after capture" in note and "--roll 90" in note for note in lost["notes"])
    found = localize(capsys, case, tmp_path / "o", *words, "--roll", "90")
    assert not any("turned since" in note for note in found["notes"])
    assert found["trusted"]
    # Turned about its axis, the camera looks where it looked.
    level, place = case.frame.place_of(case.truth), found["place"]
    assert (place["heading_deg"] - level.heading_deg + 180) % 360 - 180 == pytest.approx(0, abs=1.0)
    assert place["pitch_deg"] == pytest.approx(level.pitch_deg, abs=1.0)
    assert place["roll_deg"] == pytest.approx(level.roll_deg + 90, abs=1.0)


class TestWithoutMetadata:
    @pytest.fixture
    def case(self, tmp_path, shared_data):
        case = make_case(tmp_path, shared_data, "nrw")
        write_photo(case.photo, np.full((HEIGHT, WIDTH), 99, np.uint8))
        return case

    camera = f"PINHOLE {WIDTH} {HEIGHT} {PINHOLE.fx} {PINHOLE.fy} {PINHOLE.cx} {PINHOLE.cy}"

    def test_all_from_flags(self, capsys, tmp_path, case):
        place = case.frame.place_of(case.truth)
        words = ["--lat", place.latitude_deg + 3e-5, "--lon", place.longitude_deg, "--roll", 0.5]
        words += ["--height", place.height_m + 5, "--heading", place.heading_deg - 2]
        words += ["--pitch", place.pitch_deg]
        found = localize(
            capsys, case, tmp_path / "o", "--mask", str(case.mask), "--camera", self.camera, *map(str, words)
        )
        assert pose_error(pose_of(found["pose"]), case.truth).translation_m < 2.0

    def test_a_place_in_the_city_s_own_coordinates(self, capsys, tmp_path, case):
        center = [str(v) for v in case.truth.center + np.array([4.0, 4.0, -6.0])]
        place = case.frame.place_of(case.truth)
        words = ["--center", *center, "--heading", str(place.heading_deg), "--pitch", str(place.pitch_deg)]
        assert main([
            str(case.photo), "--city", str(case.city), "--mask", str(case.mask), "--camera", self.camera,
            "--out", str(tmp_path / "o"), *words,
        ]) == 0  # fmt: skip
        told = capsys.readouterr().out
        assert f"latitude   {place.latitude_deg:.3f}"[:16] in told
        assert "EPSG:25832+7837" in told


@pytest.fixture(scope="module")
def plain_case(tmp_path_factory, shared_data):
    return make_case(tmp_path_factory.mktemp("photo"), shared_data, "nrw")


def test_a_level_that_the_city_lacks(capsys, tmp_path, plain_case):
    words = [
        str(plain_case.photo),
        "--city",
        str(plain_case.city),
        "--mask",
        str(plain_case.mask),
        "--lod",
        "7",
    ]
    assert cli(["localize", *words, "--out", str(tmp_path / "out")]) == 2
    assert "level of detail 7" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_in_a_process_of_its_own(lodbench, tmp_path, plain_case):
    done = lodbench(
        "localize", str(plain_case.photo), "--city", str(plain_case.city), "--mask", str(plain_case.mask)
    )
    assert done.returncode == 0, done.stderr
    assert "latitude" in done.stdout
    assert {path.name for path in (tmp_path / "localized").iterdir()} == {
        f"DJI_0001{end}" for end in (".geojson", ".json", "_3d.html", "_overlay.png")
    }


def test_a_method_is_given_what_it_requires_and_no_more(capsys, monkeypatch, tmp_path, shared_data):
    from lodbench.methods import Estimate, registry
    from lodbench.methods.lodlocv2 import LodLocV2Params

    case = make_case(tmp_path, shared_data, "nrw", distorted=True)
    seen = []

    class Photographic:
        name, params_type, requires = "photographic", LodLocV2Params, frozenset({"image"})

        def __init__(self, params):
            pass

        def prepare(self, city_map, references, workspace):
            self.part = workspace.part("note.txt", lambda file: file.write_text("ready")).read_text()

        def localize(self, query, city_map, streams):
            assert (query.building_probability, self.part) == (None, "ready")
            seen.append(cv2.imread(str(query.image)).shape[:2])
            assert seen[-1] == (query.camera.height, query.camera.width)
            return Estimate(query.prior, 0.1)

    monkeypatch.setattr(registry, "load_plugin", lambda group, name: Photographic)
    found = localize(capsys, case, tmp_path / "out", "--method", "photographic")
    assert len(seen) == 1
    assert found["moved_m"] == pytest.approx(0.0, abs=1e-6)
    assert not any("do not trust" in note for note in found["notes"])
    words = ["localize", str(case.photo), "--city", str(case.city), "--method", "photographic"]
    assert cli([*words, "--mask", str(case.mask)]) == 2
    assert "photographic looks at no mask" in capsys.readouterr().err
    Photographic.requires = frozenset({"references"})
    assert cli(["localize", str(case.photo), "--city", str(case.city), "--method", "photographic"]) == 2
    assert "posed pictures of the place, and a single photo has none" in capsys.readouterr().err
