"""Posed pictures of the place: any folder in the text layout, told in one line where it lacks something."""

import json
from dataclasses import replace

import numpy as np
import pytest

from lodbench.citymodel.extrude import scene_of_blocks
from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.folder import FolderParams, open_folder, select_splits
from lodbench.datasets.inputs import Input, inputs_of, read_references
from lodbench.datasets.pose_text import FoundPose, format_camera, format_pose, lines_to_text
from lodbench.datasets.prior_sources import UniformPrior, prior_digest, with_uniform_priors
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import Camera, CameraSigmas, EulerAngles, Pose
from lodbench.harness.runs.inputs import queries_digest
from lodbench.harness.runs.queries import Preparation
from tests.town import write_dataset

POSE = "1 0 0 0 1 2 3"
CAMERA = "PINHOLE 640 512 9 9 3 2"


def write_split(folder, truth=("a.jpg",), priors=("a.jpg",), cameras=("a.jpg",)):
    """Writes the three text files of a split."""
    folder.mkdir(parents=True, exist_ok=True)
    for file, names, values in (
        ("GT_pose.txt", truth, POSE),
        ("GPS_pose.txt", priors, POSE),
        ("intrinsic.txt", cameras, CAMERA),
    ):
        (folder / file).write_text("".join(f"{name} {values}\n" for name in names))
    return folder


@pytest.fixture
def city(tmp_path):
    path = tmp_path / "city.obj"
    path.write_text("v 0 0 0\n")
    return path


def open_at(root, city):
    return open_folder(FolderParams(root=str(root), city_model=str(city)))


class TestOneFolder:
    def test_is_one_split_named_after_it(self, tmp_path, city):
        dataset = open_at(write_split(tmp_path / "flight"), city)
        assert dataset.splits == ("flight",)
        assert [entry.key for entry in dataset.entries] == ["flight/a.jpg"]
        assert set(dataset.truth) == {"flight/a.jpg"}
        assert dataset.notes == ()

    def test_the_real_demo(self, shared_data):
        demo = shared_data / "uavd4l"
        dataset = open_at(demo / "demo", demo / "UAVD4L-LoD1.obj")
        (entry,) = dataset.entries
        assert entry.image.is_file()
        assert entry.mask.is_file()
        assert entry.key in dataset.truth

    def test_flights_and_reconstructions_of_other_names_are_reported(self, tmp_path, city):
        names = ("a.jpg", "b.jpg", "c.jpg")
        root = write_split(tmp_path / "flight", names, names, names)
        (root / "sequences.txt").write_text("a.jpg east\nb east\nb.jpeg east\n")
        camera = Camera(640, 512, 9.0, 9.0, 3.0, 2.0)
        write_colmap(
            [FoundPose("a.jpg", "", Pose.from_center(np.eye(3), np.zeros(3)), camera)],
            root / "reconstruction",
        )
        dataset = open_at(root, city)
        assert [entry.sequence for entry in dataset.entries] == ["east", "", ""]
        assert dataset.notes == (
            "flight: sequences.txt names b, which is no photo here (2 such)",
            "flight: sequences.txt does not name b.jpg (2 such): these are taken for one flight",
            "flight: reconstruction has 1 of 3 photos, under their names",
        )

    def test_how_well_lenses_are_known(self, tmp_path, city):
        names = ("a.jpg", "b.jpg")
        root = write_split(tmp_path / "flight", names, names, names)
        (root / "lens_percent.txt").write_text("a.jpg 1.57\n")
        dataset = open_at(root, city)
        assert [entry.lens_percent for entry in dataset.entries] == [1.57, None]
        known = tuple(replace(entry, lens_percent=None) for entry in dataset.entries)
        assert queries_digest(dataset, dataset.entries) != queries_digest(dataset, known)

    def test_how_well_cameras_are_known(self, tmp_path, city):
        names = ("a.jpg", "b.jpg", "c.jpg")
        root = write_split(tmp_path / "flight", names, names, names)
        lines = (root / "intrinsic.txt").read_text().splitlines()
        said = ["", " sigma_f=3%", " sigma_f=0.5% sigma_c=0.35% sigma_k1=0.01 sigma_by=dewarp"]
        lines = [line + words for line, words in zip(lines, said, strict=True)]
        (root / "intrinsic.txt").write_text("\n".join(lines))
        dataset = open_at(root, city)
        assert [entry.camera_sigmas for entry in dataset.entries] == [
            None,
            CameraSigmas(3.0, 0.0, 0.0, "stated"),
            CameraSigmas(0.5, 0.35, 0.01, "dewarp"),
        ]
        assert [entry.lens_percent for entry in dataset.entries] == [None, 3.0, None]
        known = tuple(replace(entry, camera_sigmas=None) for entry in dataset.entries)
        assert queries_digest(dataset, dataset.entries) != queries_digest(dataset, known)
        (root / "intrinsic.txt").write_text(lines[0] + " sigma_f=1 2")
        with pytest.raises(DatasetError, match=r"intrinsic\.txt, line 1: '2' is no deviation"):
            open_at(root, city)

    @pytest.mark.parametrize("percent", ["0", "-1", "nan", "wide", "1 2"])
    def test_what_is_no_deviation_of_a_lens(self, tmp_path, city, percent):
        root = write_split(tmp_path / "flight")
        (root / "lens_percent.txt").write_text(f"a.jpg {percent}\n")
        with pytest.raises(DatasetError, match=r"lens_percent\.txt, line 1") as fault:
            open_at(root, city)
        assert fault.value.hint == "Each line reads: name percent"

    def test_an_entry_holds_no_truth(self, tmp_path, city):
        (entry,) = open_at(write_split(tmp_path / "flight"), city).entries
        assert not hasattr(entry, "truth")

    def test_what_is_missing_is_none_and_every_name_stays(self, tmp_path, city):
        root = write_split(
            tmp_path / "d", truth=["a.jpg", "b.jpg"], priors=["b.jpg", "c.jpg"], cameras=["z.jpg"]
        )
        dataset = open_at(root, city)
        assert [e.name for e in dataset.entries] == ["a.jpg", "b.jpg", "c.jpg"]
        assert [e.prior is None for e in dataset.entries] == [True, False, False]
        assert all(e.camera is None and e.image is None and e.mask is None for e in dataset.entries)
        assert set(dataset.truth) == {"d/a.jpg", "d/b.jpg"}
        assert dataset.notes == ("d: z.jpg has a camera but no pose",)

    def test_a_mask_has_the_photos_name_or_its_stem(self, tmp_path, city):
        photos = ["a.jpg", "b.jpg", "c.jpg"]
        root = write_split(tmp_path / "d", truth=photos, priors=photos)
        (root / "masks").mkdir()
        for name in ("a.jpg", "a.png", "b.png", "b_mask.png", "c_mask.png"):
            (root / "masks" / name).touch()
        assert [e.mask.name for e in open_at(root, city).entries] == ["a.jpg", "b.png", "c_mask.png"]


class TestSplits:
    def test_sub_folders_in_order(self, tmp_path, city):
        root = tmp_path / "data"
        for name in ("out_of_place", "in_place"):
            write_split(root / name)
        (root / "notes").mkdir()
        dataset = open_at(root, city)
        assert dataset.splits == ("in_place", "out_of_place")
        # One name in two splits is two queries.
        assert [e.key for e in dataset.entries] == ["in_place/a.jpg", "out_of_place/a.jpg"]

    def test_selection_keeps_the_datasets_order(self, tmp_path, city):
        root = tmp_path / "data"
        for name in ("a", "b", "c"):
            write_split(root / name)
        dataset = open_at(root, city)
        assert select_splits(dataset, ["c", "a"]) == ("a", "c")
        assert select_splits(dataset, []) == ("a", "b", "c")
        with pytest.raises(ConfigError, match="no split 'd'"):
            select_splits(dataset, ["d"])

    @pytest.mark.parametrize("file", ["GPS_pose.txt", "intrinsic.txt"])
    def test_none_is_left_out_for_a_misspelt_truth(self, tmp_path, city, file):
        root = tmp_path / "data"
        write_split(root / "a")
        (root / "b").mkdir()
        (root / "b" / file).write_text(f"a.jpg {POSE}\n")
        (root / "b" / "GT_poses.txt").write_text(f"a.jpg {POSE}\n")
        with pytest.raises(DatasetError, match=rf"b holds {file} and no GT_pose\.txt: .* left out") as caught:
            open_at(root, city)
        assert '{"truth": false}' in caught.value.hint

    def test_all_are_of_one_map_and_one_reference_system(self, tmp_path, city):
        """Datasets side by side, made one by one: all were taken for those of the first one's map."""
        root = tmp_path / "data"
        for name, about in (
            ("a", {}),
            ("b", {"crs": "EPSG:25832", "city_model": "../north.obj"}),
            ("c", {"crs": "urn:ogc:def:crs:EPSG::25832", "city_model": "../south.obj"}),
        ):
            write_split(root / name)
            (root / name / "dataset.json").write_text(json.dumps(about))
        for name in ("north.obj", "south.obj"):
            (root / name).write_text("v 0 0 0\n")
        assert open_at(root, city).crs == "EPSG:25832"
        with pytest.raises(DatasetError, match=r"splits b and c are of different city models: .*south\.obj"):
            open_folder(FolderParams(str(root)))
        (root / "c" / "dataset.json").write_text(json.dumps({"crs": "EPSG:25833"}))
        with pytest.raises(DatasetError, match="different reference systems: 'EPSG:25832' and 'EPSG:25833'"):
            open_at(root, city)
        (root / "c" / "dataset.json").unlink()
        assert open_folder(FolderParams(str(root))).city_model == root / "north.obj"


class TestPaths:
    @pytest.mark.parametrize("name", ["with space", "Zürich (Süd)", "a,b=c", "[1] 'quoted'", "100%"])
    def test_any_name_of_a_folder_works(self, tmp_path, name):
        root = write_split(tmp_path / name)
        (root / "masks").mkdir()
        (root / "masks" / "a.png").touch()
        city = root / f"{name}.obj"
        city.touch()
        dataset = open_at(root, city)
        assert dataset.splits == (name,)
        assert dataset.entries[0].mask == root / "masks" / "a.png"

    def test_the_home_folder_is_expanded(self, tmp_path, city, monkeypatch):
        monkeypatch.setenv("HOME", str(tmp_path))
        write_split(tmp_path / "d")
        assert open_at("~/d", city).root == tmp_path / "d"


class TestFaults:
    def test_no_such_folder(self, tmp_path, city):
        with pytest.raises(DatasetError, match="nowhere is not a folder") as caught:
            open_at(tmp_path / "nowhere", city)
        assert "dataset.root" in caught.value.hint

    def test_several_priors_of_a_query_are_its_hypotheses(self, tmp_path, city):
        root = write_split(tmp_path / "d", truth=("a.jpg", "b.jpg"), priors=("a.jpg", "b.jpg"))
        with (root / "GPS_pose.txt").open("a") as stream:
            stream.write("query/a.jpg 1 0 0 0 4 5 6\n")
        dataset = open_at(root, city)
        first, second = dataset.entries
        assert [pose.translation.tolist() for pose in first.hypotheses] == [[1, 2, 3], [4, 5, 6]]
        assert first.prior is first.hypotheses[0]
        assert (second.prior, second.hypotheses) == (second.hypotheses[0], (second.prior,))
        assert dataset.notes == ("d: 1 query has several priors; the first is the prior of each",)
        # A method may read the second, so a run that changes it is another run.
        alone = replace(first, hypotheses=first.hypotheses[:1])
        assert prior_digest([first]) != prior_digest([alone])
        assert prior_digest([alone]) == prior_digest([replace(first, hypotheses=())])

    def test_no_such_city(self, tmp_path):
        with pytest.raises(DatasetError, match=r"none\.obj does not exist"):
            open_at(write_split(tmp_path / "d"), tmp_path / "none.obj")

    def test_a_folder_without_poses(self, tmp_path, city):
        (tmp_path / "empty").mkdir()
        with pytest.raises(DatasetError, match=r"holds no GT_pose\.txt"):
            open_at(tmp_path / "empty", city)

    def test_one_made_by_hand_without_true_poses_gets_a_hint_how_to_say_so(self, tmp_path, city):
        root = write_split(tmp_path / "mine")
        (root / "GT_pose.txt").unlink()
        with pytest.raises(DatasetError, match=r"mine holds no GT_pose\.txt") as caught:
            open_at(root, city)
        told = caught.value.hint
        (root / "dataset.json").write_text(told[told.index("{") : told.index("}") + 1])
        dataset = open_at(root, city)
        assert [entry.key for entry in dataset.entries] == ["mine/a.jpg"]
        assert dataset.truth == {}
        assert dataset.notes == ("mine: there is no truth, so nothing is scored",)

    @pytest.mark.parametrize("file", ["GPS_pose.txt", "intrinsic.txt"])
    def test_a_missing_file_is_named(self, tmp_path, city, file):
        root = write_split(tmp_path / "d")
        (root / file).unlink()
        with pytest.raises(DatasetError, match=file.replace(".", r"\.")):
            open_at(root, city)

    def test_a_truth_file_without_lines(self, tmp_path, city):
        with pytest.raises(DatasetError, match="holds no poses"):
            open_at(write_split(tmp_path / "d", truth=()), city)

    @pytest.mark.parametrize("file", ["GT_pose.txt", "GPS_pose.txt", "intrinsic.txt"])
    def test_a_malformed_line_is_named(self, tmp_path, city, file):
        root = write_split(tmp_path / "d")
        with (root / file).open("a") as stream:
            stream.write("b.jpg 1 2\n")
        with pytest.raises(DatasetError, match=rf"{file.replace('.', chr(92) + '.')}, line 2"):
            open_at(root, city)


class TestMeasurements:
    LINE = "a.jpg east=0.02 north=0.03 up=0.05 pitch=0.1 range=81.2 sigma_range=0.3 takeoff=80.1 time=12.5\n"

    def test_they_belong_to_the_query_and_its_prior(self, tmp_path, city):
        folder = write_split(tmp_path / "flight")
        without = open_at(folder, city)
        (folder / "measurements.txt").write_text(self.LINE)
        dataset = open_at(folder, city)
        measured = dataset.entries[0].measured
        assert measured.sigmas == (0.02, 0.03, 0.05, 0.1, None, None)
        assert (measured.laser.range_m, measured.laser.sigma_m, measured.takeoff_height_m) == (
            81.2,
            0.3,
            80.1,
        )
        assert without.entries[0].measured is None
        scene = scene_of_blocks([(-9.0, -9.0, 9.0, 9.0, 0.0, 9.0)], dataset.entries[0].prior.center)
        preparation = Preparation(dataset, scene, None, "prior", frozenset())
        entry = replace(dataset.entries[0], camera=Camera(64, 48, 50.0, 50.0, 32.0, 24.0))
        assert preparation.query(entry).time_s == 12.5
        assert queries_digest(dataset, dataset.entries) != queries_digest(without, without.entries)
        # Of another prior nobody states a deviation; the range is the photo's.
        drawn = with_uniform_priors(dataset, UniformPrior(), 0).entries[0].measured
        assert (drawn.sigmas, drawn.laser) == ((None,) * 6, measured.laser)

    def test_the_true_tilt_has_no_deviation(self, tmp_path, city):
        folder = write_split(tmp_path / "flight")
        (folder / "measurements.txt").write_text(self.LINE)
        dataset = open_at(folder, city)

        def sigmas(tilt):
            return Preparation(dataset, None, None, tilt)._measured(dataset.entries[0]).sigmas

        assert sigmas("prior")[3] == 0.1
        assert sigmas("truth") == (0.02, 0.03, 0.05, None, None, None)

    def test_a_bad_line_is_named_and_a_stray_name_is_reported(self, tmp_path, city):
        folder = write_split(tmp_path / "flight")
        (folder / "measurements.txt").write_text("a.jpg east=0.02\nb.jpg east=1\n")
        assert any("measurements.txt names b.jpg" in note for note in open_at(folder, city).notes)
        (folder / "measurements.txt").write_text("a.jpg east=0.02\nb.jpg east=-1\n")
        with pytest.raises(DatasetError, match=r"measurements\.txt, line 2: east=-1"):
            open_at(folder, city)


PINHOLE = Camera(40, 30, 35.0, 36.0, 20.0, 15.0)
POSES = {f"r{k}.jpg": Pose.from_euler(EulerAngles(30.0, 0.0, 40.0 * k), (k, 2.0, 90.0)) for k in range(3)}


def write_references(folder, images="images", poses="poses.txt"):
    (folder / images).mkdir(parents=True, exist_ok=True)
    (folder / poses).write_text(lines_to_text(format_pose(*item) for item in POSES.items()))
    (folder / "intrinsic.txt").write_text(lines_to_text(format_camera(name, PINHOLE) for name in POSES))
    for name in POSES:
        (folder / images / name).write_bytes(b"not opened")
    return folder


@pytest.mark.parametrize(
    ("images", "poses"), [("images", "poses.txt"), ("Query_image", "GT_pose.txt"), (".", "poses.txt")]
)
def test_each_layout_is_read(tmp_path, images, poses):
    found = read_references(write_references(tmp_path, images, poses))
    assert [reference.name for reference in found] == list(POSES)
    for reference in found:
        assert reference.image.is_file()
        assert reference.camera == PINHOLE
        expected = POSES[reference.name].cam_from_world
        np.testing.assert_allclose(reference.pose.cam_from_world, expected, atol=1e-9)


def test_what_lacks_is_one_line(tmp_path):
    with pytest.raises(DatasetError, match="is not a folder"):
        read_references(tmp_path / "none")
    with pytest.raises(DatasetError, match="have no poses"):
        read_references(tmp_path)
    folder = write_references(tmp_path / "a")
    (folder / "images" / "r1.jpg").unlink()
    with pytest.raises(DatasetError, match=r"r1\.jpg .* has no picture"):
        read_references(folder)
    folder = write_references(tmp_path / "b")
    (folder / "intrinsic.txt").write_text(format_camera("r0.jpg", PINHOLE) + "\n")
    with pytest.raises(DatasetError, match=r"r1\.jpg .* has no camera"):
        read_references(folder)


def test_a_lens_that_distorts_is_refused(tmp_path):
    folder = write_references(tmp_path)
    lines = "".join(f"{name} SIMPLE_RADIAL 40 30 35 20 15 0.1\n" for name in POSES)
    (folder / "intrinsic.txt").write_text(lines)
    with pytest.raises(DatasetError, match=r"r0\.jpg .* lens distortion"):
        read_references(folder)


def test_a_dataset_names_them_by_one_key_each(tmp_path):
    root, city = write_dataset(tmp_path / "town", count=1)
    plain = open_folder(FolderParams(str(root), str(city)))
    assert not {Input.REFERENCES, Input.TEXTURED_MAP} & inputs_of(plain, plain.entries)
    references = write_references(tmp_path / "references")
    params = FolderParams(str(root), str(city), references=str(references), textured_map=str(city))
    dataset = open_folder(params)
    assert len(dataset.references) == 3
    assert inputs_of(dataset, dataset.entries) >= {Input.REFERENCES, Input.TEXTURED_MAP}
    with pytest.raises(DatasetError, match="does not exist"):
        open_folder(FolderParams(str(root), str(city), textured_map=str(tmp_path / "none.obj")))
