"""The published layouts, written in miniature, are read back to the poses they were made from."""

from pathlib import Path

import numpy as np
import pytest

from lodbench.datasets.pose_text import format_camera, format_pose, lines_to_text
from lodbench.datasets.published.layout import advice, survey
from lodbench.datasets.published.lodloc import UAVD4L_LODV2, PublishedParams, open_lodloc
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import Pose
from lodbench.plugins import load_plugin
from tests.data.published_layouts import (
    SWISS_CAMERA,
    SWISS_NAMES,
    UAVD4L_CAMERA,
    UAVD4L_NAMES,
    sensor_prior,
    small_town,
    write_lodlocv2,
    write_matrix,
    write_swiss,
    write_uavd4l,
)
from tests.photos.dji_photo import write_photo
from tests.town import CAMERA, box_obj


def open_published(params: PublishedParams) -> Dataset:
    """Returns a dataset as a run opens it."""
    return load_plugin("datasets", params.name)(params)


@pytest.fixture(scope="module")
def uavd4l(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_uavd4l(tmp_path_factory.mktemp("uavd4l"))


@pytest.fixture(scope="module")
def colmap_tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_lodlocv2(tmp_path_factory.mktemp("v2"))


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


def codes(dataset: Dataset) -> dict[str, int]:
    counts: dict[str, int] = {}
    for item in dataset.findings:
        counts[item.code.name] = counts.get(item.code.name, 0) + 1
    return counts


def assert_same(found: Pose, expected: Pose, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(found.cam_from_world, expected.cam_from_world, atol=tolerance)


class TestUavd4l:
    @pytest.mark.slow
    @pytest.mark.parametrize("name", ["uavd4l_lod", "uavd4l_lodv2"])
    def test_splits_and_poses(self, uavd4l, name):
        dataset = open_published(PublishedParams(name, str(uavd4l), frame="enu"))
        assert dataset.splits == ("in_traj", "out_of_traj", "synthetic")
        assert dataset.default_splits == ("in_traj", "out_of_traj")
        names = [*UAVD4L_NAMES["inTraj"], *UAVD4L_NAMES["outTraj"]]
        assert [entry.name for entry in dataset.entries][:4] == names
        for entry, pose in zip(dataset.entries, small_town().views, strict=True):
            assert_same(dataset.truth[entry.key], pose)
        for entry in dataset.entries[:4]:
            assert_same(entry.prior, sensor_prior(dataset.truth[entry.key], entry.name))
            assert entry.camera == UAVD4L_CAMERA
            assert entry.mask.is_file()
            assert entry.image.is_file()
        assert dataset.findings == ()

    @pytest.mark.slow
    def test_each_takes_its_own_city_model(self, uavd4l):
        files = [
            open_published(PublishedParams(name, str(uavd4l))).city_model.name
            for name in ("uavd4l_lod", "uavd4l_lodv2")
        ]
        assert files == ["UAVD4L-LoD.obj", "UAVD4L-LoD1.obj"]

    def test_any_level_of_the_tree_may_be_the_root(self, uavd4l):
        keys = [entry.key for entry in open_published(PublishedParams("uavd4l_lod", str(uavd4l))).entries]
        below = open_published(PublishedParams("uavd4l_lod", str(uavd4l / "UAVD4L-LoD")))
        assert [entry.key for entry in below.entries] == keys
        assert below.city_model is not None

    def test_the_data_folder_is_the_default_root(self, uavd4l, monkeypatch):
        monkeypatch.setenv("LODBENCH_DATA", str(uavd4l))
        assert len(open_published(PublishedParams("uavd4l_lod")).entries) == 5


class TestQuirks:
    @pytest.fixture
    def root(self, tmp_path):
        return write_uavd4l(tmp_path)

    def open(self, root, **settings):
        return open_published(PublishedParams("uavd4l_lodv2", str(root), **settings))

    def test_a_wrong_text_line_yields_to_the_matrix(self, root):
        # The released example: the second line repeats the first one's pose, its matrix is right.
        first, second = UAVD4L_NAMES["outTraj"]
        file = root / "UAVD4L-LoD" / "outTraj" / "GT_pose.txt"
        line = file.read_text().splitlines()[0]
        file.write_text(f"{line}\n{line.replace(first, second)}\n")
        assert codes(self.open(root)) == {"SAME_POSE": 1}
        write_matrix(file.parent / "GT_pose", second.split(".")[0], small_town().views[3])
        dataset = self.open(root)
        assert codes(dataset) == {"POSES_DISAGREE": 1}
        assert_same(dataset.truth[f"out_of_traj/{second}"], small_town().views[3])

    def test_names_may_have_a_folder_before_them(self, root):
        for name in ("GT_pose.txt", "GPS_pose.txt", "intrinsic.txt"):
            file = root / "UAVD4L-LoD" / "inTraj" / name
            file.write_text("".join(f"query/{line}\n" for line in file.read_text().splitlines()))
        assert self.open(root).findings == ()

    def test_other_names_of_the_priors(self, root):
        folder = root / "UAVD4L-LoD" / "inTraj"
        (folder / "GPS_pose_new.txt").write_text((folder / "GT_pose.txt").read_text())
        both = self.open(root)
        assert codes(both) == {"FILE_CHOSEN": 1}
        (folder / "GPS_pose.txt").rename(folder / "mine.txt")
        renamed = self.open(root)
        assert renamed.findings == ()
        name = UAVD4L_NAMES["inTraj"][0]
        assert_same(renamed.entries[0].prior, renamed.truth[f"in_traj/{name}"])
        with pytest.raises(ConfigError, match=r"prior_file=mime\.txt is in no split") as told:
            self.open(root, prior_file="mime.txt")
        assert "mine.txt" in told.value.hint
        chosen = self.open(root, prior_file="mine.txt")
        assert_same(chosen.entries[0].prior, both.entries[0].prior)

    def test_masks_as_the_command_names_them(self, root):
        folder = root / "UAVD4L-LoD" / "inTraj" / "masks"
        for mask in list(folder.iterdir()):
            mask.rename(mask.with_name(f"{mask.stem}_mask.png"))
        assert all(entry.mask.parent.name == "masks" for entry in self.open(root).entries[:4])

    def test_a_synthetic_name_that_states_another_pose(self, root):
        file = root / "UAVD4L-LoD" / "Synthesis" / "GT_pose.txt"
        words = file.read_text().split()
        words[-1] = repr(float(words[-1]) + 3.0)
        file.write_text(" ".join(words) + "\n")
        assert codes(self.open(root)) == {"NAME_DISAGREES": 1}

    def test_what_the_split_file_leaves_out_and_adds(self, root):
        kept = UAVD4L_NAMES["inTraj"][1]
        split = root / "UAVD4L-LoD" / "split" / "UAV_inTraj_test.json"
        split.write_text(f'{{"val": {{"inTraj": ["{kept}", "gone.JPG"]}}}}')
        dataset = self.open(root)
        assert [e.name for e in dataset.entries if e.split == "in_traj"] == [kept, "gone.JPG"]
        lost = {"NO_TRUTH": 1, "NO_PRIOR": 1, "NO_CAMERA": 1, "NO_IMAGE": 1}
        assert codes(dataset) == {"NOT_IN_SPLIT": 1, **lost}

    def test_a_missing_split_is_reported(self, root):
        (root / "UAVD4L-LoD" / "outTraj").rename(root / "elsewhere")
        dataset = self.open(root)
        assert dataset.splits == ("in_traj", "synthetic")
        assert codes(dataset) == {"SPLIT_MISSING": 1}

    @pytest.mark.parametrize(
        ("file", "line", "reason"),
        [
            ("GT_pose.txt", "{name} 1 0 0 0 1 2 3", "has a pose already"),
            ("GT_pose.txt", "x.JPG 1 1 0 0 1 2 3", "length 1.41421 instead of 1"),
            ("GPS_pose.txt", "x.JPG 1 0 0 0 nan 2 3", "not finite"),
            ("GPS_pose.txt", "x.JPG 1 0 0 0 2 3", "6 values|no pose|instead of 7"),
            ("intrinsic.txt", "{name} PINHOLE 1 1 1 1 1 1", "occurs twice"),
        ],
    )
    def test_a_bad_line_is_named(self, root, file, line, reason):
        path = root / "UAVD4L-LoD" / "inTraj" / file
        with path.open("a") as stream:
            stream.write(line.format(name=UAVD4L_NAMES["inTraj"][0]) + "\n")
        with pytest.raises(DatasetError, match=reason) as caught:
            self.open(root)
        assert f"{file}, line 3" in str(caught.value)

    def test_a_mirrored_matrix(self, root):
        folder = root / "UAVD4L-LoD" / "inTraj"
        stem = UAVD4L_NAMES["inTraj"][0].split(".")[0]
        write_matrix(folder / "GT_pose", stem, small_town().views[0])
        file = folder / "GT_pose" / f"{stem}_pose.txt"
        matrix = np.loadtxt(file)
        matrix[:3, 0] *= -1
        np.savetxt(file, matrix)
        with pytest.raises(DatasetError, match=r"determinant \+1"):
            self.open(root)

    @pytest.mark.parametrize(
        "text", ["{", "[]", '{"val": {"other": ["a"]}}', '{"val": {"inTraj": ["a", "a"]}}']
    )
    def test_a_bad_split_file(self, root, text):
        (root / "UAVD4L-LoD" / "split" / "UAV_inTraj_test.json").write_text(text)
        with pytest.raises(DatasetError, match=r"UAV_inTraj_test\.json"):
            self.open(root)


class TestSwissFrames:
    @pytest.mark.parametrize("per_image", [False, True], ids=["text", "matrices"])
    @pytest.mark.parametrize("ecef", [False, True], ids=["enu", "ecef"])
    def test_the_walls_tell_and_all_is_turned(self, tmp_path, ecef, per_image):
        root = write_swiss(tmp_path, ecef=ecef, per_image=per_image)
        dataset = open_published(PublishedParams("swiss_epflv2", str(root)))
        assert dataset.splits == ("in_place", "out_of_place")
        for entry, pose in zip(dataset.entries, small_town().views, strict=False):
            assert_same(dataset.truth[entry.key], pose, 1e-8)
            assert entry.camera == SWISS_CAMERA
            assert abs(entry.prior.center - pose.center)[2] <= 30
        assert codes(dataset) == ({"TURNED_TO_ENU": 2} if ecef else {})
        assert (dataset.city_options.ecef_origin is not None) == ecef

    def test_a_matrix_that_fits_two_names(self, tmp_path):
        root = write_swiss(tmp_path, ecef=False, per_image=True)
        name = SWISS_NAMES["inPlace"][0]
        stem = name.split("_img")[0]
        split = root / "Swiss-EPFL" / "split" / "Swiss_inPlace_test.json"
        split.write_text(split.read_text().replace(f'"{name}"', f'"{name}", "{stem}.jpg"'))
        (root / "Swiss-EPFL" / "inPlace" / "Query_image" / f"{stem}.jpg").write_bytes(
            (root / "Swiss-EPFL" / "inPlace" / "Query_image" / name).read_bytes()
        )
        found = codes(open_published(PublishedParams("swiss_epfl", str(root))))
        # Truth, prior and intrinsics each fit both names; so both names have one pose.
        assert found == {"STEM_AMBIGUOUS": 3, "SAME_POSE": 1}

    def test_city_and_poses_in_different_frames(self, tmp_path):
        root = write_swiss(tmp_path / "poses", ecef=False)
        other = write_swiss(tmp_path / "city", ecef=True)
        city = other / "MODEL" / "swiss_LoD1_final.obj"
        dataset = open_published(PublishedParams("swiss_epflv2", str(root), str(city)))
        assert codes(dataset) == {"FRAMES_DIFFER": 1, "TURNED_TO_ENU": 1}
        assert dataset.city_options.ecef_origin is not None
        assert_same(dataset.truth[dataset.entries[0].key], small_town().views[0])

    def test_the_user_can_say_it(self, tmp_path):
        root = write_swiss(tmp_path, ecef=True)
        told = open_published(PublishedParams("swiss_epfl", str(root), frame="shifted_ecef"))
        assert_same(told.truth[told.entries[0].key], small_town().views[0], 1e-8)
        with pytest.raises(ConfigError, match="frame=ecef"):
            open_published(PublishedParams("swiss_epfl", str(root), frame="ecef"))


class TestColmapTree:
    def test_poses_cameras_and_masks(self, colmap_tree):
        dataset = open_published(PublishedParams("uavd4l_lodv2", str(colmap_tree)))
        assert dataset.splits == ("in_traj", "out_of_traj")
        assert len(dataset.entries) == 4
        assert dataset.city_model.name == "move22.obj"
        for entry, pose in zip(dataset.entries, small_town().views, strict=False):
            assert_same(dataset.truth[entry.key], pose)
            assert entry.camera == UAVD4L_CAMERA
            assert entry.mask == entry.image
            np.testing.assert_allclose(entry.hypotheses[1].center - entry.prior.center, [5, 0, 0], atol=1e-9)
        assert codes(dataset) == {"SEVERAL_PRIORS": 4}

    def test_photos_in_the_masks_place_are_no_masks(self, tmp_path):
        root = write_lodlocv2(tmp_path)
        for photo in (root / "data" / "UAVD4L-LoD" / "inTraj" / "query").iterdir():
            write_photo(photo, np.random.default_rng(0).integers(0, 256, (494, 660), dtype=np.uint8))
        dataset = open_published(PublishedParams("uavd4l_lodv2", str(root)))
        assert [entry.mask is None for entry in dataset.entries] == [True, True, False, False]
        assert all(entry.image.is_file() for entry in dataset.entries)

    def test_the_swiss_scenes_lie_there_too(self, colmap_tree):
        dataset = open_published(PublishedParams("swiss_epflv2", str(colmap_tree)))
        assert [entry.name for entry in dataset.entries] == SWISS_NAMES["inPlace"]
        assert dataset.entries[0].camera == SWISS_CAMERA
        assert codes(dataset) == {"SPLIT_MISSING": 1, "SEVERAL_PRIORS": 2}


class TestMissingData:
    @pytest.mark.parametrize("name", ["uavd4l_lod", "uavd4l_lodv2", "swiss_epfl", "swiss_epflv2"])
    def test_one_screen_says_what_to_do(self, tmp_path, name):
        with pytest.raises(DatasetError, match="not all of") as caught:
            open_published(PublishedParams(name, str(tmp_path)))
        screen = caught.value.hint
        assert len(screen.splitlines()) <= 23
        for word in ("GT_pose.txt", "MODEL/", "https://", f"lodbench dataset check {name}", str(tmp_path)):
            assert word in screen

    def test_a_file_that_is_missing_is_named(self, tmp_path):
        root = write_uavd4l(tmp_path)
        (root / "UAVD4L-LoD" / "inTraj" / "intrinsic.txt").unlink()
        with pytest.raises(DatasetError) as caught:
            open_published(PublishedParams("uavd4l_lod", str(root)))
        assert "split in_traj: no intrinsic.txt" in caught.value.hint

    def test_a_city_in_a_format_that_is_not_read(self, tmp_path):
        root = write_swiss(tmp_path, ecef=False)
        model = root / "MODEL" / "Swiss-EPFL-LoD.obj"
        model.rename(model.with_name("Swiss-EPFL.osgb"))
        dataset = open_published(PublishedParams("swiss_epfl", str(root)))
        assert dataset.city_model is None
        assert "Swiss-EPFL.osgb is not read" in dataset.city_hint


def write(folder: Path, *, extra: bool) -> Path:
    split = folder / "UAVD4L-LoD" / "inTraj"
    (split / "Query_image").mkdir(parents=True)
    (folder / "MODEL").mkdir()
    (folder / "MODEL" / "UAVD4L-LoD1.obj").write_text(box_obj())
    pose = Pose.from_center(np.eye(3), np.array([1.0, 2.0, 100.0]))
    for name in ("GT_pose.txt", "GPS_pose.txt"):
        (split / name).write_text(lines_to_text([format_pose("a.jpg", pose)]))
    (split / "intrinsic.txt").write_text(lines_to_text([format_camera("a.jpg", CAMERA)]))
    if extra:
        references = folder / "UAVD4L-LoD" / "references"
        (references / "images").mkdir(parents=True)
        (references / "images" / "r.jpg").write_bytes(b"")
        (references / "poses.txt").write_text(lines_to_text([format_pose("r.jpg", pose)]))
        (references / "intrinsic.txt").write_text(lines_to_text([format_camera("r.jpg", CAMERA)]))
        (folder / "MODEL" / "textured").mkdir()
    return folder


def test_both_are_found_at_their_places(tmp_path):
    dataset = open_lodloc(PublishedParams("uavd4l_lodv2", str(write(tmp_path, extra=True))))
    assert dataset.textured_map == tmp_path / "MODEL" / "textured"
    assert [reference.name for reference in dataset.references] == ["r.jpg"]


def test_without_them_there_are_none_and_the_advice_says_where_they_belong(tmp_path):
    root = str(write(tmp_path, extra=False))
    dataset = open_lodloc(PublishedParams("uavd4l_lodv2", root))
    assert (dataset.textured_map, dataset.references) == (None, ())
    words = advice(survey(UAVD4L_LODV2, root, None))
    assert "MODEL/textured/" in words
    assert "UAVD4L-LoD/references/" in words


def test_a_map_that_is_named_and_not_there_is_reported(tmp_path):
    params = PublishedParams(
        "uavd4l_lodv2", str(write(tmp_path, extra=False)), textured_map=str(tmp_path / "none.glb")
    )
    with pytest.raises(DatasetError, match="does not exist"):
        open_lodloc(params)
