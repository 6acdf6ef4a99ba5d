"""Datasets of one's own: from photos and from models, undistorted, and run like any other."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.cli import main
from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.exchange.kapture import write_kapture
from lodbench.datasets.exchange.lines import write_lines
from lodbench.datasets.exchange.nerfstudio import write_nerfstudio
from lodbench.datasets.exchange.photogrammetry import write_metashape, write_odm
from lodbench.datasets.exchange.posed import FoundPose
from lodbench.datasets.exchange.tum import write_tum
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.pose_text import format_camera, lines_to_text, read_cameras, read_poses
from lodbench.datasets.undistort import pinhole_of
from lodbench.evaluation import pose_error
from lodbench.geometry import Camera
from tests.cli.photo_case import DISTORTION, HEIGHT, PINHOLE, WIDTH, Case, make_case
from tests.datasets.dji_photo import PROPERTIES, exif_of, write_photo, xmp_packet

LENS = Camera(
    WIDTH, HEIGHT, PINHOLE.fx, PINHOLE.fy, PINHOLE.cx, PINHOLE.cy, (*DISTORTION, 0.0, 0.0, 0.0), "FULL_OPENCV"
)


@pytest.fixture(scope="module")
def case(tmp_path_factory, shared_data) -> Case:
    """A distorted photo of a real city in a folder of its own, its mask in another."""
    folder = tmp_path_factory.mktemp("own")
    case = make_case(folder, shared_data, "nrw", distorted=True)
    (folder / "flight").mkdir()
    (folder / "masks").mkdir()
    shutil.move(case.photo, folder / "flight" / "DJI_0001.JPG")
    shutil.move(case.mask, folder / "masks" / "DJI_0001.png")
    case.photo, case.mask = folder / "flight" / "DJI_0001.JPG", folder / "masks" / "DJI_0001.png"
    return case


def run(capsys, command: str, *words) -> tuple[int, str, str]:
    code = main([*command.split(), *map(str, words)])
    told = capsys.readouterr()
    return code, told.out, told.err


def init(capsys, case: Case, root: Path, *words) -> str:
    code, out, err = run(
        capsys,
        "dataset init",
        root,
        "--images",
        case.photo.parent,
        "--city",
        case.city,
        "--masks",
        case.mask.parent,
        *words,
    )
    assert code == 0, err
    return out


class TestFromPhotos:
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
        code, told, err = run(
            capsys,
            "run",
            "dataset=folder",
            f"dataset.root={tmp_path / 'town'}",
            f"dataset.city_model={case.city}",
            f"paths.runs={tmp_path / 'runs'}",
        )
        assert code == 0, err
        assert "no true pose to compare with" not in told
        (folder,) = (tmp_path / "runs/folder/lodlocv2").iterdir()
        found = read_poses(folder / "poses.txt")["DJI_0001.JPG"]
        assert pose_error(found, case.truth).translation_m < 2.0
        summary = json.loads((folder / "summary.json").read_text())
        assert summary["splits"]["town"]["num_queries"] == 0
        assert len(list((folder / "overlays").glob("*.png"))) == 1
        code, told, err = run(capsys, "verify", folder)
        assert code == 0, told + err
        # And its poses go to a map.
        code, told, err = run(
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

    def test_flights_are_told_apart(self, capsys, tmp_path, case):
        """A run of a method for flights took both for one."""
        photo = case.photo.read_bytes()
        for folder, clock in (("a", b"2023:10:18 11"), ("b", b"2023:10:18 15")):
            for number in (1, 2):
                copy = tmp_path / "flights" / folder / f"DJI_{folder}{number}.JPG"
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(photo.replace(b"2023:10:18 11", clock))
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
        code, _, err = run(
            capsys, "dataset init", tmp_path / "town", "--images", tmp_path / "flights", "--city", case.city
        )
        assert code == 2
        assert "2 images are called DJI_0001.JPG" in err


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


class TestImport:
    WRITERS = {  # noqa: RUF012
        "colmap": (write_colmap, "model"),
        "kapture": (write_kapture, "kapture"),
        "nerfstudio": (write_nerfstudio, "transforms.json"),
        "tum": (write_tum, "poses.tum"),
        "visuallocalization": (write_lines, "poses.txt"),
    }

    @pytest.mark.parametrize("name", WRITERS)
    def test_every_format_becomes_the_same_dataset(self, capsys, tmp_path, case, name):
        write, file = self.WRITERS[name]
        write([FoundPose("DJI_0001.JPG", "", case.truth, LENS)], tmp_path / file)
        (tmp_path / "cameras.txt").write_text(lines_to_text([format_camera("DJI_0001.JPG", LENS)]))
        words = ["--cameras", tmp_path / "cameras.txt"] if name in ("tum", "visuallocalization") else []
        code, out, err = run(
            capsys,
            "dataset import",
            name,
            tmp_path / file,
            tmp_path / "town",
            "--images",
            case.photo.parent,
            *words,
        )
        assert code == 0, err
        assert "prior=uniform" in out
        root = tmp_path / "town"
        assert not (root / "GPS_pose.txt").exists()
        (truth,) = read_poses(root / "GT_pose.txt").values()
        assert pose_error(truth, case.truth).translation_m < 1e-7
        assert read_cameras(root / "intrinsic.txt") == {"DJI_0001.JPG": pinhole_of(LENS)}
        dataset = open_folder(FolderParams(str(root), str(case.city)))
        assert any("prior=uniform" in note for note in dataset.notes)

    @pytest.mark.parametrize("label", ["DJI_0001", "DJI_0001.jpg"])
    def test_labels_find_their_photo_without_its_ending_or_in_other_letters(
        self, capsys, tmp_path, case, label
    ):
        write_metashape([FoundPose(label, "", case.truth)], tmp_path / "reference.txt")
        camera = format_camera("", LENS).strip()
        words = ["--images", case.photo.parent, "--masks", case.mask.parent, "--camera", camera]
        paths = tmp_path / "reference.txt", tmp_path / "town"
        code, _, err = run(capsys, "dataset import metashape", *paths, *words)
        assert code == 0, err
        assert (tmp_path / "town/Query_image/DJI_0001.JPG").is_file()
        assert (tmp_path / "town/masks/DJI_0001.png").is_file()
        assert list(read_poses(tmp_path / "town/GT_pose.txt")) == ["DJI_0001.JPG"]

    def test_blender_s_files_lack_sizes_of_pictures_and_their_endings(self, capsys, tmp_path, case):
        write_nerfstudio([FoundPose("./flight/DJI_0001", "", case.truth, LENS)], tmp_path / "transforms.json")
        values = json.loads((tmp_path / "transforms.json").read_text())
        (frame,) = values["frames"]
        kept = {key: frame[key] for key in ("file_path", "transform_matrix")}
        values |= {"camera_angle_x": 1.2, "frames": [kept]}
        (tmp_path / "transforms.json").write_text(json.dumps(values))
        paths = tmp_path / "transforms.json", tmp_path / "town", "--images", case.photo.parents[1]
        code, _, err = run(capsys, "dataset import nerfstudio", *paths)
        assert (code, "--camera" in err) == (2, True)
        words = "--camera", format_camera("", LENS).strip()
        code, _, err = run(capsys, "dataset import nerfstudio", *paths, *words)
        assert code == 0, err
        assert list(read_poses(tmp_path / "town/GT_pose.txt")) == ["DJI_0001.JPG"]

    def test_without_photos_the_next_command_is_one_that_runs(self, capsys, tmp_path, case):
        write_odm([FoundPose("a.jpg", "", case.truth)], tmp_path / "geo.txt", "EPSG:25832")
        words = ["--city", case.city, "--camera", format_camera("", PINHOLE).strip()]
        _, out, _ = run(capsys, "dataset import odm", tmp_path / "geo.txt", tmp_path / "town", *words)
        command = shlex.split(out.splitlines()[-1].removeprefix("Next: lodbench "))
        assert "method=contour_alignment" in command
        runs = f"paths.runs={tmp_path / 'runs'}"
        code, _, err = run(capsys, "", *command, runs)
        assert code == 0, err
        # What the hint of a method that looks at photos names is the same.
        code, _, err = run(capsys, "run method=region", *command[1:3], "prior=uniform", runs)
        assert code == 2
        assert "method=contour_alignment needs none with segmenter=masks or segmenter=oracle" in err

    def test_poses_in_another_system_than_the_city_s_are_brought_there(self, capsys, tmp_path, case):
        write_odm([FoundPose("a.jpg", "", case.truth)], tmp_path / "geo.txt", "EPSG:25832")
        text = (tmp_path / "geo.txt").read_text().replace("EPSG:25832", "EPSG:23032")
        (tmp_path / "geo.txt").write_text(text)
        words = ["--city", case.city, "--camera", format_camera("", LENS).strip()]
        code, out, err = run(capsys, "dataset import odm", tmp_path / "geo.txt", tmp_path / "town", *words)
        assert code == 0, err
        assert "note: poses in EPSG:23032 brought to EPSG:25832" in out
        (truth,) = read_poses(tmp_path / "town/GT_pose.txt").values()
        # What European Datum 1950 lies beside ETRS89 there.
        assert truth.center - case.truth.center == pytest.approx([-81.2, -202.5, 0.0], abs=2.0)

    def test_a_label_that_two_photos_have_finds_neither(self, capsys, tmp_path, case):
        shutil.copytree(case.photo.parent, tmp_path / "photos")
        shutil.copy(case.photo, tmp_path / "photos" / "DJI_0001.tif")
        write_metashape([FoundPose("DJI_0001", "", case.truth)], tmp_path / "reference.txt")
        words = ["--images", tmp_path / "photos", "--camera", format_camera("", LENS).strip()]
        paths = tmp_path / "reference.txt", tmp_path / "town"
        code, _, err = run(capsys, "dataset import metashape", *paths, *words)
        assert (code, "no such photo" in err) == (2, True)

    def test_images_without_camera_or_photo_or_pose_are_named(self, capsys, tmp_path, case):
        images = [FoundPose(f"{i}.jpg", "", case.truth, LENS) for i in range(3)]
        write_kapture(images, tmp_path / "k")
        trajectories = tmp_path / "k/sensors/trajectories.txt"
        text = trajectories.read_text().splitlines()
        trajectories.write_text("\n".join(line for line in text if not line.startswith("2, ")))
        photos = tmp_path / "photos"
        photos.mkdir()
        write_photo(photos / "0.jpg", np.zeros((HEIGHT, WIDTH), np.uint8))
        code, out, err = run(
            capsys, "dataset import kapture", tmp_path / "k", tmp_path / "t", "--images", photos
        )
        assert code == 0, err
        assert "left out: 1.jpg: no such photo" in out
        assert "left out: 2.jpg: no pose" in out

    def test_a_name_that_leads_out_of_the_folder_finds_nothing(self, capsys, tmp_path, case):
        (tmp_path / "photos").mkdir()
        write_photo(tmp_path / "secret.jpg", np.zeros((HEIGHT, WIDTH), np.uint8))
        for name in ("../secret.jpg", str(tmp_path / "secret.jpg")):
            write_colmap([FoundPose(name, "", case.truth, LENS)], tmp_path / "m")
            code, _, err = run(
                capsys,
                "dataset import colmap",
                tmp_path / "m",
                tmp_path / "t",
                "--images",
                tmp_path / "photos",
            )
            assert code == 2
            assert "no such photo" in err

    def test_a_photo_of_another_size_than_its_camera(self, capsys, tmp_path, case):
        write_colmap([FoundPose("0.jpg", "", case.truth, LENS)], tmp_path / "m")
        (tmp_path / "photos").mkdir()
        write_photo(tmp_path / "photos" / "0.jpg", np.zeros((20, 30), np.uint8))
        code, _, err = run(
            capsys, "dataset import colmap", tmp_path / "m", tmp_path / "t", "--images", tmp_path / "photos"
        )
        assert code == 2
        assert "30 x 20" in err
