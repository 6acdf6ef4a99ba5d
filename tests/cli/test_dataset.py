"""`lodbench dataset list | check | prior`, as a person uses them."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from lodbench.datasets.pose_text import format_pose, inverted, lines_to_text, read_poses
from lodbench.geometry import Pose
from tests.data.published_layouts import UAVD4L_NAMES, write_swiss, write_uavd4l
from tests.town import write_dataset

from .test_faults import is_clear


@pytest.fixture(scope="module")
def uavd4l(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_uavd4l(tmp_path_factory.mktemp("uavd4l"))


def check(lodbench, *words: str) -> tuple[int, dict]:
    done = lodbench("dataset", "check", *words, "--json")
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)


def found(values: dict) -> dict[str, int]:
    names = [item["name"] for item in values["findings"]]
    return {name: names.count(name) for name in names}


class TestList:
    def test_what_is_there_and_what_is_not(self, lodbench, uavd4l):
        done = lodbench("dataset", "list", LODBENCH_DATA=str(uavd4l))
        assert done.returncode == 0
        assert re.search(r"^uavd4l_lodv2  complete, [\d.]+ MiB: UAVD4L-LoDv2, LoD1$", done.stdout, re.M)
        assert "swiss_epfl    not there" in done.stdout
        assert "https://" in done.stdout

    def test_an_incomplete_one(self, lodbench, tmp_path):
        root = write_swiss(tmp_path, ecef=False)
        (root / "Swiss-EPFL" / "inPlace" / "GPS_pose.txt").unlink()
        (swiss,) = (
            item
            for item in json.loads(lodbench("dataset", "list", "--root", str(root), "--json").stdout)
            if item["name"] == "swiss_epfl"
        )
        assert swiss["missing"] == ["split in_place: no GPS_pose.txt"]
        assert swiss["bytes"] > 10_000

    def test_every_dataset_there_is_has_a_title_and_a_card(self, lodbench):
        listed = lodbench("dataset", "list").stdout
        assert "has no card" not in listed
        for name in ("demo", "demo_train", "flights", "folder", "views"):
            assert re.search(rf"^{name} +\S", listed, re.M)
            assert lodbench("dataset", "card", name).stdout.count("# ") >= 1


class TestCheck:
    def test_the_miniature_differs_from_the_paper_and_nothing_else(self, lodbench, uavd4l):
        code, values = check(lodbench, "uavd4l_lodv2", "--root", str(uavd4l))
        assert found(values) == {
            "CHECKSUM_DIFFERS": 1,
            "GPS_IN_IMAGE": 5,
            "COUNT_UNEXPECTED": 2,
            "PRIORS_UNLIKE_PAPER": 2,
        }
        assert code == 0
        split = values["splits"]["out_of_traj"]
        assert (split["queries"], split["expected"], split["paper_prior_median"]) == (2, 2192, [11.1, 0.92])
        text = lodbench("dataset", "check", "uavd4l_lodv2", "--root", str(uavd4l)).stdout
        assert "in_traj: 2 queries, 2 with a true pose (the paper's tables imply 1604), 2 photos" in text
        assert "(paper: 6.48 m / 1.63 deg)" in text

    def test_bad_photos_are_counted(self, lodbench, tmp_path):
        root = write_uavd4l(tmp_path)
        photos = root / "UAVD4L-LoD" / "inTraj" / "Query_image"
        first, second = (photos / name for name in UAVD4L_NAMES["inTraj"])
        whole = first.read_bytes()
        first.write_bytes(whole[: len(whole) // 2])
        Image.new("L", (66, 49)).save(second)
        others = root / "UAVD4L-LoD" / "outTraj" / "Query_image"
        (others / UAVD4L_NAMES["outTraj"][0]).write_bytes(b"no picture")
        # A header that claims more pixels than any camera has, and no pixel behind it.
        huge = bytearray(whole)
        start = huge.index(b"\xff\xc0")
        huge[start + 5 : start + 9] = b"\xff\xff\xff\xff"
        (others / UAVD4L_NAMES["outTraj"][1]).write_bytes(huge)
        code, values = check(lodbench, "uavd4l_lod", "--root", str(root))
        assert code == 1
        details = [
            (item["name"], item["object"].split("/")[-1], item["detail"]) for item in values["findings"]
        ]
        bad = {name: detail for kind, name, detail in details if kind == "IMAGE_UNREADABLE"}
        assert "damaged or cut off" in bad[first.name]
        assert "not a JPEG" in bad[UAVD4L_NAMES["outTraj"][0]]
        assert "too many pixels" in bad[UAVD4L_NAMES["outTraj"][1]]
        assert ("IMAGE_SIZE", second.name, "66 x 49, intrinsics 660 x 494") in details
        quick = check(lodbench, "uavd4l_lod", "--root", str(root), "--headers-only")[1]
        assert found(quick)["IMAGE_UNREADABLE"] == 2

    def test_a_folder_of_ones_own(self, lodbench, tmp_path):
        root, city = write_dataset(tmp_path / "town")
        code, values = check(lodbench, str(root), "--city", str(city))
        # Three photos are not there at all; priors are as drawn.
        assert (code, found(values)) == (0, {})
        assert values["splits"]["data"]["prior_median"] == pytest.approx([77**0.5, 3.0], abs=1e-6)
        code, values = check(lodbench, str(root))
        assert (code, found(values)) == (1, {"FILE_MISSING": 1})

    def test_how_far_cameras_look_off_straight_down_whatever_way_they_are_turned(self, lodbench, tmp_path):
        """A kite's camera turns about its optical axis: at 20 degrees off, angles told -14 to 13."""
        root, city = write_dataset(tmp_path / "town", count=6)
        turned = {}
        for number, (name, pose) in enumerate(read_poses(root / "GT_pose.txt").items()):
            about_axis = Rotation.from_euler("z", 35.0 + 70.0 * number, degrees=True).as_matrix()
            turned[name] = Pose.from_center(about_axis @ pose.rotation, pose.center)
        (root / "GT_pose.txt").write_text(lines_to_text(format_pose(*each) for each in turned.items()))
        off = [np.degrees(np.arccos(-pose.rotation[2, 2])) for pose in turned.values()]
        assert min(off) > 19
        _, values = check(lodbench, str(root), "--city", str(city))
        expected = [min(off), np.median(off), max(off)]
        assert values["splits"]["data"]["off_nadir_deg"] == pytest.approx(expected)
        told = lodbench("dataset", "check", str(root), "--city", str(city)).stdout
        assert f"looking {min(off):.0f} to {max(off):.0f} deg off straight down" in told

    def test_missing_data_is_explained(self, lodbench, tmp_path):
        done = lodbench("dataset", "check", "swiss_epflv2", "--root", str(tmp_path / "none"))
        assert done.returncode == 2
        assert "https://" in done.stderr
        assert "neither a dataset nor a folder" in lodbench("dataset", "check", "siwss_epfl").stderr


class TestDirection:
    @pytest.fixture
    def turned(self, tmp_path) -> tuple[Path, Path]:
        """A dataset some way from its zero whose true poses and priors are written camera to world."""
        root, city = write_dataset(tmp_path / "town", count=6)
        rows = [line.split() for line in city.read_text().splitlines()]
        moved = [["v", str(int(r[1]) + 900), str(int(r[2]) + 400), r[3]] if r[0] == "v" else r for r in rows]
        city.write_text(lines_to_text(map(" ".join, moved)))
        for name in ("GT_pose.txt", "GPS_pose.txt"):
            poses = {key: pose.shifted([900, 400, 0]) for key, pose in read_poses(root / name).items()}
            lines = [format_pose(key, inverted(pose)) for key, pose in poses.items()]
            (root / name).write_text(lines_to_text(lines))
        return root, city

    def test_the_check_says_so(self, lodbench, turned):
        code, values = check(lodbench, str(turned[0]), "--city", str(turned[1]))
        wrong = [item for item in values["findings"] if item["name"] == "WRONG_DIRECTION"]
        assert code == 1
        assert [item["object"] for item in wrong] == ["data: true poses", "data: priors"]
        assert "6 if read camera to world" in wrong[0]["detail"]

    def test_a_run_stops_before_any_work(self, lodbench, turned, tmp_path):
        words = ("dataset=folder", f"dataset.root={turned[0]}", f"dataset.city_model={turned[1]}")
        done = lodbench("run", *words)
        assert done.returncode == 2
        assert "wrong way round" in done.stderr
        assert "world to camera" in done.stderr
        assert not (tmp_path / "runs").exists()


class TestPriors:
    def words(self, root: Path, city: Path) -> list[str]:
        return ["dataset=folder", f"dataset.root={root}", f"dataset.city_model={city}", "method=prior_only"]

    def test_drawn_once_written_and_read_back(self, lodbench, tmp_path):
        root, city = write_dataset(tmp_path / "town")
        out = tmp_path / "priors = drawn, once.txt"
        make = ("dataset", "prior", str(root), "--kind", "basin", "--set", "range_m=40", "--seed", "7")
        done = lodbench(*make, "--out", str(out))
        assert done.returncode == 0, done.stderr
        digest = re.search(r"digest (\w+)", done.stdout)[1]
        assert out.read_text().startswith("# priors uniform around the truth: +-40/40/40 m in x/y/z, +-7.5")
        assert out.read_text().splitlines()[0].endswith(f"seed 7; digest {digest}")
        first = out.read_bytes()
        lodbench(*make, "--out", str(out))
        assert out.read_bytes() == first
        # The same priors, drawn in the run and read from the file, give the same errors.
        drawn = lodbench("run", *self.words(root, city), "prior=basin", "prior.range_m=40", "seed=7")
        read = lodbench("run", *self.words(root, city), f"prior.path={out}", "seed=7")
        assert (drawn.returncode, read.returncode) == (0, 0), drawn.stderr + read.stderr
        runs = sorted((tmp_path / "runs").glob("*/*/*"))
        summaries = [json.loads((run / "summary.json").read_text()) for run in runs]
        medians = [summary["prior"]["data"]["median_translation_m"] for summary in summaries]
        assert medians[0] == pytest.approx(medians[1], abs=1e-9)
        words = sorted(summary["protocol"]["prior"] for summary in summaries)
        assert words[0].startswith("of another file (")
        assert words[1].startswith("uniform around the truth: +-40/40/40 m")
        for run, summary in zip(runs, summaries, strict=True):
            assert len(read_poses(run / "priors.txt")) == 3
            assert len(summary["dataset"]["priors"]) == 12
            verified = lodbench("verify", str(run))
            assert verified.returncode == 0, verified.stdout

    def test_poses_that_a_dataset_came_with_are_not_replaced(self, lodbench, tmp_path):
        root, _ = write_dataset(tmp_path / "town")
        own = root / "GPS_pose.txt"
        before = own.read_bytes()
        done = lodbench("dataset", "prior", str(root), "--kind", "uniform", "--out", str(own))
        assert (done.returncode, done.stdout) == (2, "")
        assert "GPS_pose.txt is there already" in done.stderr
        assert "--out FILE" in done.stderr
        assert own.read_bytes() == before

    def test_a_file_without_priors_is_not_written(self, lodbench, tmp_path):
        root, _ = write_dataset(tmp_path / "town")
        (root / "GPS_pose.txt").unlink()
        (root / "dataset.json").write_text('{"priors": false}')
        done = lodbench("dataset", "prior", str(root), "--kind", "file", "--out", "a.txt")
        is_clear(done, "has a prior of --kind file")
        is_clear(lodbench("dataset", "prior", str(root), "--set", "x=1", "--out", "a.txt"), "--set x is not")
        assert not (tmp_path / "a.txt").exists()

    def test_a_changed_file_of_priors_is_found(self, lodbench, tmp_path):
        root, city = write_dataset(tmp_path / "town")
        assert lodbench("run", *self.words(root, city), "prior=uniform").returncode == 0
        (run,) = (tmp_path / "runs").glob("*/*/*")
        (run / "priors.txt").write_text((run / "priors.txt").read_text().replace("1", "2"))
        assert "priors.txt is not the file the run wrote" in lodbench("verify", str(run)).stdout
        (run / "priors.txt").unlink()
        assert "priors.txt is missing" in lodbench("verify", str(run)).stdout

    def test_what_the_photos_state(self, lodbench, uavd4l, tmp_path):
        words = ("dataset", "prior", "uavd4l_lodv2", "--root", str(uavd4l), "--kind", "sensor")
        refused = lodbench(*words, "--out", str(tmp_path / "p.txt"))
        assert refused.returncode == 2
        assert "withheld by its publishers" in refused.stderr
        assert not (tmp_path / "p.txt").exists()
        run = lodbench(
            "run", "dataset=uavd4l_lodv2", f"dataset.root={uavd4l}", "prior=sensor", "method=prior_only",
            "dataset.origin=[400000,3130000,0]", "prior.heights=sea_level",
        )  # fmt: skip
        assert run.returncode == 0, run.stderr
        (folder,) = (tmp_path / "runs").glob("*/*/*")
        stated = read_poses(folder / "priors.txt")
        published = read_poses(uavd4l / "UAVD4L-LoD" / "inTraj" / "GPS_pose.txt")
        for name, pose in published.items():
            # DJI writes positions to a millimetre or two here, heights and angles to a hundredth.
            assert np.abs(stated[name].center - pose.center).max() < 0.02
            assert np.abs(np.array(stated[name].euler) - pose.euler).max() < 0.02
        # The origin that the publishers withhold is in no file of the run.
        for file in folder.rglob("*.*"):
            assert not re.search(rb"(?<![\d.])3130000(?!\d)", file.read_bytes()), file
        verified = lodbench("verify", str(folder))
        assert verified.returncode == 0, verified.stdout + verified.stderr
        assert "the run's own priors.txt" in verified.stdout

    @pytest.mark.parametrize(
        ("line", "reason"), [("gone.png 1 0 0 0 1 2 3", "not a query"), ("view_00.png 1 0 0 0 1 2", "line 1")]
    )
    def test_a_bad_file_of_priors(self, lodbench, tmp_path, line, reason):
        root, city = write_dataset(tmp_path / "town")
        (tmp_path / "p.txt").write_text(line + "\n")
        done = lodbench("run", *self.words(root, city), "prior.path=p.txt")
        assert done.returncode == 2
        assert reason in done.stderr


def test_the_report_is_indented_and_names_an_absent_city_model(lodbench, tmp_path):
    root = write_swiss(tmp_path, ecef=False)
    (root / "MODEL" / "Swiss-EPFL-LoD.obj").unlink()
    done = lodbench("dataset", "check", "swiss_epfl", "--root", str(root))
    assert done.returncode == 1
    assert "\n  city model: none\n" in done.stdout
    assert "\n    city model: none of Swiss-EPFL-LoD.obj, Swiss-EPFL.obj\n" in done.stdout
