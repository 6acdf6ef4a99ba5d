"""Datasets of one's own: from photos and from models, undistorted, and run like any other."""

import json
import shutil
from dataclasses import astuple

import cv2
import numpy as np
import pytest

from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.own import OwnImage
from lodbench.datasets.pose_text import FoundPose, read_cameras, read_poses
from lodbench.evaluation import pose_error
from lodbench.geometry import Camera, CameraSigmas, EulerAngles, Pose
from lodbench.harness.photo.own_dataset import without_common_view
from lodbench.photos.camera import pinhole_of
from tests.cli.photo_case import Case
from tests.harness.own_case import LENS, init, make_own_case, run
from tests.photos.dji_photo import PROPERTIES, exif_of, write_photo, xmp_packet
from tests.town import CAMERA, write_dataset


@pytest.fixture(scope="module")
def case(tmp_path_factory, shared_data) -> Case:
    return make_own_case(tmp_path_factory.mktemp("own"), shared_data)


class TestFromPhotos:
    @pytest.mark.slow
    def test_the_dataset_is_a_pinhole_s_and_runs(self, capsys, tmp_path, case):
        out = init(capsys, case, tmp_path / "town")
        assert "1 image, 1 with a prior, without truth, 1 undistorted" in out
        assert f"dataset.root={tmp_path / 'town'}" in out
        assert "segmenter" not in out
        dataset = open_folder(FolderParams(str(tmp_path / "town"), str(case.city)))
        (entry,) = dataset.entries
        assert entry.camera == pinhole_of(LENS)
        assert pose_error(entry.prior, case.truth).translation_m == pytest.approx(13.49, abs=0.05)
        assert entry.image.is_file()
        assert any("no truth" in note for note in dataset.notes)
        # The dataset runs: without a truth there is a pose, and nothing is scored.
        code, reported, err = run(
            capsys,
            "run",
            "dataset=folder",
            f"dataset.root={tmp_path / 'town'}",
            f"dataset.city_model={case.city}",
            f"paths.runs={tmp_path / 'runs'}",
        )
        assert code == 0, err
        assert "no true pose to compare with" not in reported
        (folder,) = (tmp_path / "runs/folder/lodlocv2").iterdir()
        found = read_poses(folder / "poses.txt")["DJI_0001.JPG"]
        assert pose_error(found, case.truth).translation_m < 2.0
        summary = json.loads((folder / "summary.json").read_text())
        assert summary["splits"]["town"]["num_queries"] == 0
        assert len(list((folder / "overlays").glob("*.png"))) == 1
        code, reported, err = run(capsys, "verify", folder)
        assert code == 0, reported + err
        # And its poses go to a map.
        code, reported, err = run(
            capsys, "export", folder, "--format", "geojson", "--out", tmp_path / "a.geojson"
        )
        assert code == 0, err
        (feature,) = json.loads((tmp_path / "a.geojson").read_text())["features"]
        place = case.frame.place_of(found)
        assert feature["geometry"]["coordinates"] == pytest.approx(
            [place.longitude_deg, place.latitude_deg], abs=1e-8
        )

    def test_true_tilt_needs_a_truth(self, capsys, tmp_path, case):
        init(capsys, case, tmp_path / "town")
        code, _, err = run(
            capsys,
            "run",
            "dataset=folder",
            f"dataset.root={tmp_path / 'town'}",
            "tilt=truth",
            f"dataset.city_model={case.city}",
            f"paths.runs={tmp_path / 'runs'}",
        )
        assert code == 2
        assert "tilt=truth" in err

    def test_the_undistorted_mask_is_the_city_seen_by_the_pinhole(self, capsys, tmp_path, case):
        from lodbench.citymodel import open_scene
        from lodbench.rendering import make_renderer

        init(capsys, case, tmp_path / "town")
        mask = cv2.imread(str(tmp_path / "town/masks/DJI_0001.png"), cv2.IMREAD_UNCHANGED) >= 128
        scene = open_scene(case.city)
        camera = read_cameras(tmp_path / "town/intrinsic.txt")["DJI_0001.JPG"]
        drawn = make_renderer("silhouette", scene).render(camera, case.truth.shifted(-scene.origin))
        # Two resamplings of a hard-edged mask cost some pixels of its outlines.
        assert (mask & drawn).sum() / (mask | drawn).sum() > 0.98
        # Left distorted it would not fit.
        raw = cv2.imread(str(case.mask), cv2.IMREAD_UNCHANGED) >= 128
        assert (raw & drawn).sum() / (raw | drawn).sum() < 0.9

    def test_what_is_left_out_is_named(self, capsys, tmp_path, case):
        flight = tmp_path / "flight"
        shutil.copytree(case.photo.parent, flight)
        write_photo(flight / "silent.jpg", exif=exif_of())
        (flight / "broken.jpg").write_bytes(b"\xff\xd8\xff")
        (photo,) = case.photo.parent.glob("*.JPG")
        (flight / "cut.jpg").write_bytes(photo.read_bytes()[: photo.stat().st_size // 2])
        elsewhere = {
            **PROPERTIES,
            "GpsLatitude": "48.0",
            "GpsLongitude": "11.0",
            "CalibratedFocalLength": "50",
        }
        write_photo(flight / "far.jpg", xmp=xmp_packet(elsewhere))
        out = init(capsys, case, tmp_path / "town", "--images", flight)
        assert "1 image" in out
        assert "left out: silent.jpg: silent.jpg does not say where" in out
        assert "left out: broken.jpg" in out
        assert "cut.jpg is damaged or cut off" in out
        assert " km outside the city model" in out.split("left out: far.jpg: ")[1]
        about = json.loads((tmp_path / "town/dataset.json").read_text())
        assert {name for name, _ in about["left_out"]} == {"silent.jpg", "broken.jpg", "cut.jpg", "far.jpg"}
        assert about["crs"] == "EPSG:25832+7837"

    @pytest.mark.parametrize(
        ("words", "expected"),
        [
            (["--images", "EMPTY"], ["holds no photos"]),
            (["--images", "nowhere"], ["nowhere"]),
            (["--heights", "ellipsoid"], ["geoid", "--geoid"]),
            (["--crs", "EPSG:25833"], ["outside the city"]),
            (["--height-offset", "-2000"], ["m below the city model", "--takeoff"]),
            (["--camera", "FISHY 9 9 1 1"], ["FISHY"]),
        ],
    )
    def test_faults_leave_nothing(self, capsys, tmp_path, case, words, expected):
        (tmp_path / "empty").mkdir()
        words = [str(tmp_path / "empty") if word == "EMPTY" else word for word in words]
        code, _, err = run(
            capsys,
            "dataset init",
            tmp_path / "town",
            "--images",
            case.photo.parent,
            "--city",
            case.city,
            *words,
        )
        assert code == 2
        for word in expected:
            assert word in err
        assert not (tmp_path / "town").exists()

    def test_masks_among_the_photos_are_no_photos(self, capsys, tmp_path, case):
        shutil.copytree(case.photo.parent, tmp_path / "flight")
        shutil.copytree(case.mask.parent, tmp_path / "flight" / "masks")
        words = ["--images", tmp_path / "flight", "--masks", tmp_path / "flight" / "masks"]
        out = init(capsys, case, tmp_path / "town", *words)
        assert "1 image" in out
        assert "left out" not in out

    def test_without_masks_the_next_command_needs_none(self, capsys, tmp_path, case):
        code, out, err = run(
            capsys, "dataset init", tmp_path / "town", "--images", case.photo.parent, "--city", case.city
        )
        assert code == 0, err
        assert out.splitlines()[-1].endswith(" method=region")

    def test_the_next_command_reads_the_city_as_it_was_read_here(self, capsys, tmp_path, case):
        out = init(capsys, case, tmp_path / "town", "--lod", "2", "--crs", "EPSG:25832+7837")
        assert " dataset.crs=EPSG:25832+7837 dataset.lod=2" in out.splitlines()[-1]

    def test_flights_are_reported_apart(self, capsys, tmp_path, case):
        """A run of a method for flights took both for one."""
        photo = case.photo.read_bytes()
        for folder, clock in (("a", b"2023:10:18 11"), ("b", b"2023:10:18 15")):
            for number in (1, 2):
                copy = tmp_path / "flights" / folder / f"DJI_{folder}{number}.JPG"
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(photo.replace(b"2023:10:18 11", clock) + bytes(number))
        words = ["--images", tmp_path / "flights", "--city", case.city]
        code, _, err = run(capsys, "dataset init", tmp_path / "town", *words)
        assert code == 0, err
        entries = open_folder(FolderParams(str(tmp_path / "town"), str(case.city))).entries
        assert [(entry.name, entry.sequence) for entry in entries] == [
            ("DJI_a1.JPG", "flight_1"),
            ("DJI_a2.JPG", "flight_1"),
            ("DJI_b1.JPG", "flight_2"),
            ("DJI_b2.JPG", "flight_2"),
        ]

    @pytest.mark.parametrize(
        ("changes", "percent", "sigmas"),
        [
            ([], None, (0.5, 0.35, 0.01, "dewarp")),
            ([(b"DewarpData", b"DewarpNone")], 1.0, (1.5, 0.7, 0.03, "sensor")),
            ([(b"DewarpData", b"DewarpNone"), (b"FC6310R", b"FC6310X")], 1.56, (1.56, 0.7, 0.03, "35mm")),
        ],
        ids=["calibrated", "sensor", "35mm"],
    )
    def test_a_focal_length_stays_known_as_well_as_it_is(
        self, capsys, tmp_path, case, changes, percent, sigmas
    ):
        photo = case.photo.read_bytes()
        for old, new in changes:
            assert old in photo
            photo = photo.replace(old, new)
        (tmp_path / "flight").mkdir()
        (tmp_path / "flight" / "DJI_0001.JPG").write_bytes(photo)
        words = ["--images", tmp_path / "flight", "--city", case.city]
        code, _, err = run(capsys, "dataset init", tmp_path / "town", *words)
        assert code == 0, err
        (entry,) = open_folder(FolderParams(str(tmp_path / "town"), str(case.city))).entries
        assert entry.lens_percent == percent
        assert astuple(entry.camera_sigmas) == sigmas

    def test_a_camera_that_is_given_is_exact_unless_its_deviations_are_given_too(
        self, capsys, tmp_path, case
    ):
        camera = "SIMPLE_PINHOLE 684 456 460 342 228"
        for name, words in (("exact", ""), ("stated", " sigma_f=3% sigma_c=1%")):
            given = ["--images", case.photo.parent, "--city", case.city, "--camera", camera + words]
            code, _, err = run(capsys, "dataset init", tmp_path / name, *given)
            assert code == 0, err
        exact, stated = (
            open_folder(FolderParams(str(tmp_path / name), str(case.city))).entries[0]
            for name in ("exact", "stated")
        )
        assert (exact.camera_sigmas, exact.lens_percent) == (None, None)
        assert (stated.camera_sigmas, stated.lens_percent) == (CameraSigmas(3.0, 1.0, 0.0, "stated"), 3.0)

    def test_a_panorama_beside_the_photos_is_left_out(self, capsys, tmp_path, case):
        flight = tmp_path / "flight"
        shutil.copytree(case.photo.parent, flight)
        sphere = xmp_packet(PROPERTIES).replace(
            b"drone-dji:Gimbal",
            b'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
            b'GPano:ProjectionType="equirectangular" drone-dji:Gimbal',
            1,
        )
        write_photo(flight / "DJI_0002_PANO.JPG", np.zeros((32, 64), np.uint8), exif_of(), sphere)
        words = ["--images", flight, "--city", case.city]
        code, out, err = run(capsys, "dataset init", tmp_path / "town", *words)
        assert code == 0, err
        assert "town: 1 image" in out
        assert "left out: DJI_0002_PANO.JPG: DJI_0002_PANO.JPG is a panorama (equirectangular)" in out
        sphere_alone = [flight / "DJI_0002_PANO.JPG", "--city", case.city, "--out", tmp_path / "o"]
        code, _, err = run(capsys, "localize", *sphere_alone)
        assert code == 2
        assert "is a panorama" in err

    def test_nothing_is_written_over(self, capsys, tmp_path, case):
        (tmp_path / "town").mkdir()
        (tmp_path / "town" / "mine.txt").write_text("mine")
        code, _, err = run(
            capsys, "dataset init", tmp_path / "town", "--images", case.photo.parent, "--city", case.city
        )
        assert code == 2
        assert "there already" in err
        assert [path.name for path in (tmp_path / "town").iterdir()] == ["mine.txt"]

    def test_two_photos_of_one_name(self, capsys, tmp_path, case):
        for folder in ("a", "b"):
            shutil.copytree(case.photo.parent, tmp_path / "flights" / folder)
        other = tmp_path / "flights" / "b" / case.photo.name
        other.write_bytes(other.read_bytes() + b"\0")
        code, _, err = run(
            capsys, "dataset init", tmp_path / "town", "--images", tmp_path / "flights", "--city", case.city
        )
        assert code == 2
        assert "2 images are called DJI_0001.JPG" in err

    def test_a_copy_is_no_photo_of_its_own(self, capsys, tmp_path, case):
        """Methods for flights took two of one photo for two that agree."""
        for name in ("DJI_0001.JPG", "copies/DJI_0001.JPG", "DJI_0001 (1).JPG"):
            copy = tmp_path / "flight" / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(case.photo, copy)
        words = ["--images", tmp_path / "flight", "--city", case.city, "--masks", case.mask.parent]
        code, out, err = run(capsys, "dataset init", tmp_path / "town", *words)
        assert code == 0, err
        assert "1 image, 1 with a prior" in out
        assert out.count("it is a copy of") == 2
        # It comes first in the folder, and has no mask.
        assert "DJI_0001 (1).JPG: it is a copy of" in out
        assert "no mask" not in out
        entries = open_folder(FolderParams(str(tmp_path / "town"), str(case.city))).entries
        assert len(entries) == 1


class TestFromColmap:
    @pytest.mark.parametrize("is_binary", [False, True])
    def test_poses_are_the_truth_and_photos_give_the_priors(self, capsys, tmp_path, case, is_binary):
        offset = np.array([280000.0, 5657000.0, 0.0])
        model = [FoundPose("DJI_0001.JPG", "", case.truth.shifted(-offset), LENS)]
        write_colmap(model, tmp_path / "sparse")
        if is_binary:
            pycolmap = pytest.importorskip("pycolmap")
            pycolmap.Reconstruction(str(tmp_path / "sparse")).write_binary(str(tmp_path / "sparse"))
            for file in (tmp_path / "sparse").glob("*.txt"):
                file.unlink()
        out = init(
            capsys, case, tmp_path / "town", "--colmap", tmp_path / "sparse", "--offset", *map(str, offset)
        )
        assert "1 with a prior, with truth, 1 undistorted" in out
        dataset = open_folder(FolderParams(str(tmp_path / "town"), str(case.city)))
        (entry,) = dataset.entries
        assert entry.camera == pinhole_of(LENS)
        error = pose_error(dataset.truth[entry.key], case.truth)
        assert error.translation_m < 1e-6
        assert error.rotation_deg < 1e-9
        assert pose_error(entry.prior, case.truth).translation_m == pytest.approx(13.49, abs=0.05)

    def test_a_model_in_another_frame_is_refused(self, capsys, tmp_path, case):
        write_colmap(
            [FoundPose("DJI_0001.JPG", "", case.truth.shifted([-280000, 0, 0]), LENS)], tmp_path / "s"
        )
        code, _, err = run(
            capsys,
            "dataset init",
            tmp_path / "town",
            "--images",
            case.photo.parent,
            "--city",
            case.city,
            "--colmap",
            tmp_path / "s",
        )
        assert code == 2
        assert "--offset" in err


class TestNoCommonView:
    def test_the_first_of_two_that_see_the_same_ground_stays(self):
        # Looking straight down from 100 m, a photo shows 100 x 100 m; lowest ground is at 20 m.
        camera = Camera(200, 200, 200.0, 200.0, 100.0, 100.0)
        down = EulerAngles(0.0, 0.0, 30.0)
        places = {"a": (0, 0), "b": (60, 0), "c": (150, 0), "d": (150, 160), "e": (0, 141)}
        images = [
            OwnImage(name, camera, truth=Pose.from_euler(down, (*place, 120.0)))
            for name, place in places.items()
        ]
        kept, left_out = without_common_view([*images, OwnImage("f", camera)], 20.0, 300.0)
        # Turned by 30 degrees, squares of 100 m reach 68 m to each side: b meets a; e is 141 m from a.
        assert [image.name for image in kept] == ["a", "c", "d", "e"]
        assert left_out == [("b", "its view meets that of a"), ("f", "no pose to tell what it sees by")]

    def test_a_view_to_the_horizon_ends_where_it_is_cut_off(self):
        camera = Camera(200, 200, 200.0, 200.0, 100.0, 100.0)
        east = [
            Pose.from_euler(EulerAngles(90.0, 0.0, yaw), (x, 0.0, 22.0)) for x, yaw in ((0, -90), (400, 90))
        ]
        images = [OwnImage(name, camera, prior=pose) for name, pose in zip("ab", east, strict=True)]
        assert len(without_common_view(images, 20.0, 190.0)[0]) == 2
        assert len(without_common_view(images, 20.0, 210.0)[0]) == 1

    def test_dataset_init_says_what_it_left_out(self, tmp_path, capsys):
        root, city = write_dataset(tmp_path / "data", 3)
        posed = [FoundPose(name, "", pose, CAMERA) for name, pose in read_poses(root / "GT_pose.txt").items()]
        write_colmap(posed, tmp_path / "model")
        (tmp_path / "photos").mkdir()
        for name in (pose.name for pose in posed):
            cv2.imwrite(
                str(tmp_path / "photos" / name), np.full((CAMERA.height, CAMERA.width, 3), 90, np.uint8)
            )
        words = ["--images", tmp_path / "photos", "--city", city, "--colmap", tmp_path / "model"]
        code, reported, err = run(capsys, "dataset", "init", tmp_path / "all", *words)
        assert (code, reported.splitlines()[0].split(": ")[1][:8]) == (0, "3 images"), err
        code, reported, err = run(capsys, "dataset", "init", tmp_path / "apart", *words, "--no-common-view")
        assert code == 0, err
        assert "1 image," in reported
        assert reported.count("its view meets that of view_00.png") == 2
        code, reported, err = run(
            capsys, "dataset", "init", tmp_path / "none", *words, "--no-common-view", "-3"
        )
        assert code == 2
        assert "--no-common-view" in err
