"""Datasets of one's own from poses that other programs made."""

import json
import shlex
import shutil

import numpy as np
import pytest

from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.exchange.kapture_nerfstudio import write_kapture, write_nerfstudio
from lodbench.datasets.exchange.lines import write_lines, write_tum
from lodbench.datasets.exchange.photogrammetry import write_metashape, write_odm
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.pose_text import FoundPose, format_camera, lines_to_text, read_cameras, read_poses
from lodbench.evaluation import pose_error
from lodbench.photos.camera import pinhole_of
from tests.cli.photo_case import HEIGHT, PINHOLE, WIDTH, Case
from tests.harness.own_case import LENS, make_own_case, run
from tests.photos.dji_photo import write_photo


@pytest.fixture(scope="module")
def case(tmp_path_factory, shared_data) -> Case:
    return make_own_case(tmp_path_factory.mktemp("own"), shared_data)


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
